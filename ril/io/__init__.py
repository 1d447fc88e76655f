"""Rows, files, locks, signals, errors and paths: input and output without runs or methods."""
