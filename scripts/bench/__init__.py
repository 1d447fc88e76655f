"""The measurements of `scripts/benchmark.py`, a file per question."""
