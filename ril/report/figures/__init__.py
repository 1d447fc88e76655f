"""The report's figures: plain data in, a matplotlib figure out."""
