"""The memory of a process that trains: kept from update to update, and returned now and then.

By default the C library returns large blocks to the system at once, which clears their pages again
at the next update: an eighth of PPO's time on CartPole. Kept for good, glibc's heap would grow to
several times what is used, because it seldom reuses freed blocks that torch has asked for aligned.
"""

from __future__ import annotations

import ctypes
import functools
import platform
import time
from typing import Any

_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # parameters of malloc.h
_SECONDS = 5.0

_last = 0.0


@functools.cache
def _glibc() -> Any:
    """Return the C library if it is glibc, or else None."""
    return ctypes.CDLL(None) if platform.libc_ver()[0] == "glibc" else None


def keep_memory() -> None:
    """Let this process keep freed memory for its next update."""
    if (libc := _glibc()) is not None:
        libc.mallopt(_MMAP_THRESHOLD, 2**25)  # bytes; the largest value of all versions
        libc.mallopt(_TRIM_THRESHOLD, 2**30)


def return_unused() -> None:
    """Return unused memory to the system, at most once in five seconds."""
    global _last
    if time.monotonic() - _last > _SECONDS and (libc := _glibc()) is not None:
        libc.malloc_trim(0)
        _last = time.monotonic()
