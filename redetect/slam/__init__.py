"""Uses of landmarks: least-squares map, localisation, EKF-SLAM, association, noise.

Frames are the data set's: the robot has X left, Y backward (forward is -Y); the map is the robot's
frame at the start of the run. A pose is (x, y, theta). Metres, radians.

>>> from redetect.slam.recording import read_recording
>>> recording = read_recording("images/e", circles=True, lines=True)    # doctest: +SKIP
"""
