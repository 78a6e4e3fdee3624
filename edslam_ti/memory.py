"""Memory that is free, given back to the system."""

import ctypes
from collections.abc import Callable


def _found_trim() -> Callable[[int], int] | None:
    """Return glibc's malloc_trim, None where there is another C library."""
    try:
        return ctypes.CDLL("libc.so.6").malloc_trim
    except (OSError, AttributeError):
        return None


_trim = _found_trim()


def release_free_memory() -> None:
    """Give back to the system what the allocator keeps between what is in use; with glibc, else nothing.

    Arrays of always other sizes leave gaps that none of the next fits into, so that a process grows though
    what it keeps does not. Takes milliseconds.
    """
    if _trim is not None:
        _trim(0)
