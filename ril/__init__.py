"""Reproduce "Sample-Efficient Self-Supervised Imitation Learning" from the command line."""

from importlib.metadata import PackageNotFoundError, version

from ril import kernels

kernels.fix()  # before any module of ril imports NumPy or torch

#: The distribution's name: on PyPI, "ril" is another project, an image library.
DISTRIBUTION = "ril-imitation"

try:
    __version__ = version(DISTRIBUTION)
except PackageNotFoundError:  # a checkout on PYTHONPATH that is not installed
    __version__ = "unknown"
