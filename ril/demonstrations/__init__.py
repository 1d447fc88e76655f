"""Expert trajectories, and the files that store them."""
