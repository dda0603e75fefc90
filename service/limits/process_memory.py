"""How much memory this process has, and what glibc keeps of it; elsewhere than on Linux there is nothing to do."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from pathlib import Path

#: Allocations of at least this many bytes are mapped instead of taken from the heap, so that freeing them returns the
#: memory to the system at once.
MMAP_THRESHOLD = 4 * 2**20
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # malloc.h


def tune_malloc() -> None:
    """One heap for all threads, given back at its end; to be called before there are threads.

    By default each thread has a heap of its own that keeps the largest shape it has worked on: 40 MB more with two
    workers. Arrays of a request stay on the heap, because fresh pages for each would cost time.
    """
    if mallopt := _glibc("mallopt"):
        for parameter, value in ((_ARENA_MAX, 1), (_TRIM_THRESHOLD, 16 * 2**20), (_MMAP_THRESHOLD, MMAP_THRESHOLD)):
            mallopt(ctypes.c_int(parameter), ctypes.c_int(value))


def trim_heap() -> None:
    """Return to the system what making models has left over."""
    if trim := _glibc("malloc_trim"):
        trim(ctypes.c_size_t(0))


def mapped_size() -> int:
    """Bytes of addresses that this process has mapped; 0 where the system doesn't tell."""
    return _pages(0)


def resident_size() -> int:
    """Bytes of this process that are in memory; 0 where the system doesn't tell."""
    return _pages(1)


def _pages(column: int) -> int:
    try:
        return int(Path("/proc/self/statm").read_text().split()[column]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def _glibc(name: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
