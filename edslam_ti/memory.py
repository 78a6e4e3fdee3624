"""Returns free memory to the operating system."""

import ctypes
from collections.abc import Callable


def _found_trim() -> Callable[[int], int] | None:
    """Return glibc's malloc_trim; None with another C library."""
    try:
        return ctypes.CDLL("libc.so.6").malloc_trim
    except (OSError, AttributeError):
        return None


_trim = _found_trim()


def release_free_memory() -> None:
    """Return free memory from glibc's allocator to the system; does nothing with another C library.

    Allocations of varying size fragment the heap, so the process grows although live memory does not. Takes
    milliseconds.
    """
    if _trim is not None:
        _trim(0)
