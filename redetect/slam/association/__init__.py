"""Data association: which rows of a run show the same landmark.

`run` calls the stages: `frame_to_frame` against a local map that moves with the robot, detection of
revisited places by constellations of landmarks (`loops`), the resulting path (`loop_closing`), and
verticals along it (`line_points`). `registration` registers a run in a map. `compatibility` gates
single rows or tests them jointly; `scoring` compares with known identifiers.
"""
