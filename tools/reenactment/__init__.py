"""From a recorded run's landmark file to the world that it was recorded in.

`python -m tools.reenactment prepare` fits path, discs, the camera's true mounting and the robot's
tilt to a landmark file, so that the run can be rendered again and its images searched for discs
where the recording found them.
"""
