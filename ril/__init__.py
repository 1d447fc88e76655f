"""Reproduce "Sample-Efficient Self-Supervised Imitation Learning" from the command line."""

from importlib.metadata import version

__version__ = version("ril")
