"""Which rows of a run show the same landmark.

`run` is the way through: `frame_to_frame` against a map that travels with the robot, places met
again by constellations of landmarks (`loops`), and the path that they say (`loop_closing`);
verticals along it (`line_points`). `placing` lays a run on a map. `compatibility` gates single rows
or tests them jointly; `score` compares with identifiers that are known.
"""
