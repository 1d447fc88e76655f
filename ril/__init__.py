"""Reproduce "Sample-Efficient Self-Supervised Imitation Learning" from the command line."""

from importlib.metadata import PackageNotFoundError, version

#: The distribution's name: on PyPI, "ril" is another project, an image library.
DISTRIBUTION = "ril-imitation"

try:
    __version__ = version(DISTRIBUTION)
except PackageNotFoundError:  # a checkout on PYTHONPATH that is not installed
    __version__ = "unknown"
