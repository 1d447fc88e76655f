"""The paper as data: its tables, its claims, and where they contradict each other."""
