"""Turns rows on disk into the paper's tables, figures and pages, without importing any method."""
