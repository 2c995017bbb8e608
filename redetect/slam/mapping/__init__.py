"""The least-squares map of a run.

`run_map` is the way from rows to a map: `graph` holds the measurements and unknowns, `graph_terms`
their whitened errors and Jacobians, `initial_lines` the start of lines, `solve` (or `solve_gtsam`)
the minimum and its covariances. `audit` finds mistaken identifiers.
"""
