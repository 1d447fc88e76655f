"""Rows on disk to the paper's tables; knows no method."""
