"""How colcon builds and installs the node."""

from setuptools import setup

setup(
    name="redetect_ros",
    version="0.1.0",
    description="Discs on the floor and verticals of the building in images, with covariances",
    license="BSD-3-Clause",
    packages=["redetect_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/redetect_ros"]),
        ("share/redetect_ros", ["package.xml"]),
        ("share/redetect_ros/launch", ["launch/redetect.launch.xml"]),
    ],
    install_requires=["redetect", "setuptools"],
    entry_points={"console_scripts": ["redetect_node = redetect_ros.node:main"]},
)
