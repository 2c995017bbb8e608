"""Where frames come from: one small module per source, behind one interface (`interface`).

::

    source             module        how it is named
    run folder         image_files   the folder
    images             image_files   a folder, one image, or a pattern such as 'drive/*.png'
    video file         video         the file
    ROS bag, MCAP      bag           the .bag or .mcap file, or the folder of a ROS 2 bag
    live camera        video         camera:0

A source gives images in order, with their times if it has them. Odometry is added to it
(`poses`), so that any source may be combined with any odometry; `opening` puts both together.
"""
