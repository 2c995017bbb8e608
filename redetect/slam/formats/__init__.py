"""Files of other tools: g2o graphs, TUM trajectories, data sets, comma-separated tables."""
