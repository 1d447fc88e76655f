"""Expert trajectories: what they hold, and the files that they come in."""
