"""The paper as data: its tables, its claims, and the audit of their contradictions."""
