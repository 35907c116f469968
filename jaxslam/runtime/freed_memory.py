"""Memory that is free but still counted as the process's own."""

import ctypes
import sys
from functools import cache
from typing import Any


def return_freed_memory() -> None:
    """Return what the C library keeps of freed memory to the system. Does nothing without glibc.

    Compiling and loading programs frees memory in small pieces, of which glibc keeps most: `jaxslam run` on
    Bonn `crowd` occupies 0.80 GB instead of 0.94 while it tracks, and 0.82 instead of 1.0 after compiling all.
    """
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


@cache
def _malloc_trim() -> Any:
    """Find glibc's `malloc_trim`; `None` in systems with another C library."""
    if sys.platform != "linux":
        return None
    return getattr(ctypes.CDLL(None), "malloc_trim", None)
