"""Reproduce "Sample-Efficient Self-Supervised Imitation Learning" from the command line."""
