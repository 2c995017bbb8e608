"""The least-squares map of a run.

`run_map` makes a map from rows: `graph` has the measurements and unknowns, `graph_terms` their
whitened errors and Jacobians, `initial_lines` the initial lines, `solve` (or `solve_gtsam`) the
minimum and its covariances. `audit` finds wrong identifiers.
"""
