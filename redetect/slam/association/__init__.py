"""Which rows of a run show the same landmark.

`run` is the way through: `frame_to_frame` against a `local_map`, places met again by constellations
of landmarks (`loops`), and the path that they say (`loop_path`). `compatibility` gates single rows
or tests them jointly; `score` compares with identifiers that are known.
"""
