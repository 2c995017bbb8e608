"""Sources of frames: one small module per source, behind one interface (`interface`).

::

    source             module        name
    run folder         image_files   the folder
    images             image_files   a folder, one image, or a pattern such as 'drive/*.png'
    video file         video         the file
    ROS bag, MCAP      bag           the .bag or .mcap file, or the folder of a ROS 2 bag
    live camera        video         camera:0

A source yields images in order, with their times if known. Odometry is separate (`poses`), so that
any source can be combined with any odometry; `opening` combines both.
"""
