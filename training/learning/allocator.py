"""Settings of glibc's allocator while networks are trained. On systems other than Linux with glibc they do nothing."""

import ctypes
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

#: Parameters of mallopt, from malloc.h: the greatest free end of the heap, and the greatest number of mapped arrays.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
#: The free end that stays after training, and glibc's number of mapped arrays.
_AFTERWARDS, _MAPPED = 64 * 2**20, 65536


@contextmanager
def memory_kept() -> Iterator[None]:
    """Keep freed memory for the next step of training, and return it to the system at the end.

    By default, glibc maps large arrays anew in each step. The system then clears hundreds of megabytes, which takes
    more than half of the time of convolutions. No figure changes.
    """
    tune, trim = (_glibc(name) for name in ("mallopt", "malloc_trim"))
    if tune is None or trim is None:
        yield
        return
    tune(_MMAP_MAX, 0)
    tune(_TRIM_THRESHOLD, 2**31 - 1)
    try:
        yield
    finally:
        tune(_MMAP_MAX, _MAPPED)
        tune(_TRIM_THRESHOLD, _AFTERWARDS)
        trim(ctypes.c_size_t(0))


def _glibc(name: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
