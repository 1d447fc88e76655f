"""Training an expert to a given return, and collecting its trajectories."""
