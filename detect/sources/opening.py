"""A run from the name of whatever holds its images.

Readers of sources other than folders are imported on demand.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from camera import Camera, read_camera
from detect.errors import DetectError
from detect.run import (
    Frames,
    ImageRun,
    Run,
    open_images,
    open_run,
)
from detect.sources.image_names import IMAGE_SUFFIXES, images_of_folder
from detect.sources.options import SourceOptions

if TYPE_CHECKING:
    from detect.sources.interface import Source
    from detect.sources.odometry import SourceFrames

# How the description of a ROS 2 bag begins.
_BAG_KEY, _LOOKED_AT = b"rosbag2_bagfile_information", 4096

_LIVE = re.compile(r"camera:([0-9]{1,4})")


def open_calibrated(
    name: Path, camera_path: Path | None = None, options: SourceOptions | None = None
) -> Run:
    """Open what holds a run's images, with a calibration.

    Parameters
    ----------
    name : path
        A run folder, a folder of images, an image or a pattern of images, a video, a bag, or
        ``camera:0``.
    camera_path : path, optional
        The calibration; by default the one beside the images.
    options : SourceOptions, optional
        Further options.

    Returns
    -------
    Run

    Raises
    ------
    DetectError
        If there is no such thing, it cannot be read, or there is no calibration.
    camera.CameraError, landmarks.LandmarkFileError
        If the calibration or the odometry cannot be read.
    """
    run = _open(name, camera_path, options or SourceOptions(), posed=True)
    if isinstance(run, Run):
        return run
    raise DetectError(
        f"{name}: no calibration: expected a .cam file beside the images, or one named by "
        "--camera; `camera calibrate` makes one"
    )


def open_source(
    name: Path, camera_path: Path | None = None, options: SourceOptions | None = None
) -> ImageRun:
    """Open what holds a run's images, with the calibration that there may be.

    Parameters
    ----------
    name, camera_path, options
        As in `open_calibrated`.

    Returns
    -------
    ImageRun
        A `Run` if there is a calibration.

    Raises
    ------
    DetectError, camera.CameraError, landmarks.LandmarkFileError
        As `open_calibrated`, except for a missing calibration.
    """
    return _open(name, camera_path, options or SourceOptions(), posed=False)


def demand_recording(name: Path) -> None:
    """Refuse a live camera where existing rows are used: its images are not theirs.

    Raises
    ------
    DetectError
        If this names one.
    """
    if _LIVE.fullmatch(str(name)):
        raise DetectError(
            f"{name}: shows other images now than those that the rows are from: expected a "
            "recording: a folder or pattern of images, a video or a bag"
        )


def _open(name: Path, camera_path: Path | None, options: SourceOptions, *, posed: bool) -> ImageRun:
    """Open any source, with a calibration where there is one; `posed`: one with a pose."""
    if name.is_dir() and not _is_ros2_bag(name) and options.plain:
        # A run folder as the data set has them, with nothing more to be said of it.
        opened = open_run if posed else open_images
        return _shortened(opened(name, camera_path, bits=options.bits or None), options.frames)
    from detect.sources.interface import Calibration

    source = _source(name, options)
    calibration = (
        Calibration(read_camera(camera_path)) if camera_path is not None else source.calibration()
    )
    camera = None if calibration is None else calibration.camera
    if calibration is not None:
        if posed and calibration.why_no_pose is not None:
            raise DetectError(calibration.why_no_pose)
        _demand_size(source, calibration.camera)
    frames, odometry = _frames(source, options)
    run = ImageRun(
        source.output_base.parent,
        frames,
        odometry,
        source.output_base,
        has_times=source.has_times,
    )
    run = _shortened(run, options.frames)
    return run if camera is None else run.calibrated(camera)


def _source(name: Path, options: SourceOptions) -> Source:
    from detect.sources.bag import BAG_SUFFIXES, Bag
    from detect.sources.bag_camera import BASE_FRAME
    from detect.sources.live import LiveCamera
    from detect.sources.pictures import WILDCARDS, ImageFiles, home_of, matching_images, own_times
    from detect.sources.times import TimesByImage
    from detect.sources.video import VideoFile

    live = _LIVE.fullmatch(str(name))
    is_bag = _is_ros2_bag(name) or name.suffix.lower() in BAG_SUFFIXES
    if options.image_topic and not is_bag:
        raise DetectError(f"{name}: --image-topic {options.image_topic}: only bags have topics")
    if options.base_frame and not is_bag:
        raise DetectError(f"{name}: --base-frame {options.base_frame}: only bags have frames")
    bits = options.bits or None
    if live is not None:
        return LiveCamera(int(live[1]))
    if is_bag and name.exists():
        base = options.base_frame or BASE_FRAME
        return Bag(name, options.image_topic or None, bits, base)
    is_file = name.is_file()
    if is_file and name.suffix.lower() not in IMAGE_SUFFIXES:
        return VideoFile(name)
    if is_file or (not name.exists() and WILDCARDS & set(str(name))):
        images = matching_images(str(name))
        home = home_of(name.parent)
    elif name.is_dir():
        images = images_of_folder(name)
        home = name
    else:
        raise DetectError(
            f"{name}: no such folder or file: expected a run folder, a folder of images, a pattern "
            "of images in quotes ('drive/*.png'), a video, a bag (.bag, .mcap), or camera:0"
        )
    own = Path(options.times) if options.times else own_times(home)
    return ImageFiles(images, str(name), home, None if own is None else TimesByImage(own), bits)


def _frames(source: Source, options: SourceOptions) -> tuple[SourceFrames, Path | None]:
    """The frames of a source with the odometry that is wanted, and the file of that."""
    from detect.sources.odometry import FramesAlongPoses, FramesAlongRows, SourceFrames
    from detect.sources.poses import TumTrajectory

    wanted = options.odometry
    if options.times and source.times_own:
        raise DetectError(f"{source.name}: --times {options.times}: its images have their own")
    if wanted == "none":
        return SourceFrames(source), None
    if wanted.startswith("/") and not (Path(wanted).suffix or Path(wanted).exists()):
        poses = source.poses(wanted)
    elif wanted.endswith(".tum"):
        poses = TumTrajectory(Path(wanted), options.odometry_axes)
    elif wanted:
        return FramesAlongRows(source, Path(wanted)), Path(wanted)
    else:
        poses = source.poses(None)
    if poses is None:
        return SourceFrames(source), None
    if not source.has_times:
        raise DetectError(
            f"{source.name}: no times of the images: a trajectory needs them: "
            "name a file of rows 'prefix seconds' by --times"
        )
    return FramesAlongPoses(source, poses), poses.path


def _shortened(run: ImageRun, count: int) -> ImageRun:
    if not count:
        return run
    from detect.sources.odometry import FirstFrames

    frames: Frames = FirstFrames(run.frames, count)
    return replace(run, frames=frames)


def _demand_size(source: Source, camera: Camera) -> None:
    """Refuse a video of another size at once: none of its frames could be worked on."""
    if source.size is not None and source.size != (camera.width, camera.height):
        raise DetectError(
            f"{source.name}: is {source.size[0]}x{source.size[1]} px: expected "
            f"{camera.width}x{camera.height}, the calibration's size: "
            "name the calibration of this video by --camera"
        )


def _is_ros2_bag(name: Path) -> bool:
    try:
        with (name / "metadata.yaml").open("rb") as stream:
            return _BAG_KEY in stream.read(_LOOKED_AT)
    except OSError:
        return False
