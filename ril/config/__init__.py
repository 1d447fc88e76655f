"""The configuration that all methods share, as dataclasses, and the bounds of its values."""
