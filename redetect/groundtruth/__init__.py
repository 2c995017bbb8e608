"""Where the robot really was: markers, lasers, clocks, their fusion and its validation.

Each package imports only from those named here; `errors`, `files` and `settings` serve all:

- `trajectories`: rigid motions in space and in the plane; poses over time and their files.
- `markers`: poses from square markers, rigs and networks of cameras: `trajectories`.
- `lasers`: scanners, scans, matching, alignment, tracking: `trajectories`.
- `fusion`: odometry and measured poses together, and the robot's clock: `trajectories`.
- `validation`: errors against a truth and at reference poses: `fusion`, `lasers`, `trajectories`.
- `report`: a session on one page, and pictures beside results: `validation` and before.
- `commands`: files and messages of all of these, with the flags in `options`; `cli` calls them.

Frames: the *robot* has x forward, y left, z up; the *world* z up, and the robot's heading theta is
its x axis' angle in the world, counter-clockwise; *cameras* and *markers* as in `camera` and
`landmarks`. A transform `a_from_b` maps points of frame b to frame a. Metres, radians, seconds.
"""
