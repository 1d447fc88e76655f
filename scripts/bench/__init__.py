"""The measurements of `scripts/benchmark.py`, one file per question."""
