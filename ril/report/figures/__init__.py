"""The report's figures: plain data in, a drawing out."""
