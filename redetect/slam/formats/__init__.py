"""Files of other tools: g2o graphs, TUM trajectories, comma-separated tables."""
