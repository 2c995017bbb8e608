"""The least-squares map of a run.

`run_map` makes a map from rows: `graph` has the measurements, unknowns and their first estimates,
`graph_terms` whitened errors and Jacobians, `solve` (or `solve_gtsam`) the minimum and its
covariances. `audit` finds wrong identifiers.
"""
