"""Train an expert to a given return and collect its trajectories."""
