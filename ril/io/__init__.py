"""Rows, atomic files, locks, signals and errors; nothing here knows what a run or a method is."""
