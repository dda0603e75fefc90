"""Memory of this process, and settings of glibc's allocator. On systems other than Linux the functions do nothing."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from pathlib import Path

#: Allocations of at least this many bytes are mapped instead of taken from the heap. When they are freed, the system
#: gets the memory back at once.
MMAP_THRESHOLD = 4 * 2**20
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # malloc.h


def tune_malloc() -> None:
    """Make all threads use one heap, whose free end goes back to the system. Call it before threads start.

    By default each thread has its own heap, which keeps the memory of the largest shape: 40 MB more with two workers.
    Arrays of a request stay on the heap, because fresh pages for each array would take time.
    """
    if mallopt := _glibc("mallopt"):
        for parameter, value in ((_ARENA_MAX, 1), (_TRIM_THRESHOLD, 16 * 2**20), (_MMAP_THRESHOLD, MMAP_THRESHOLD)):
            mallopt(ctypes.c_int(parameter), ctypes.c_int(value))


def trim_heap() -> None:
    """Return free memory of the heap to the system."""
    if trim := _glibc("malloc_trim"):
        trim(ctypes.c_size_t(0))


def mapped_size() -> int:
    """Return the mapped memory of this process in bytes, or 0 if it is unknown."""
    return _pages(0)


def resident_size() -> int:
    """Return the resident memory of this process in bytes, or 0 if it is unknown."""
    return _pages(1)


def _pages(column: int) -> int:
    try:
        return int(Path("/proc/self/statm").read_text().split()[column]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def _glibc(name: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
