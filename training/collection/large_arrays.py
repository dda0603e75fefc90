"""Arrays of whole collections, which need not fit into memory: large arrays lie in a temporary file."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import DTypeLike, NDArray

from shapespace.arrays import FloatArray, IntArray

#: Bytes of the largest array that is kept in memory.
IN_MEMORY = 2**27
#: Number of values that are processed at a time.
TOGETHER = 2**22


def room(shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray:
    """Return an array to be filled, in memory or in a temporary file that disappears with the array.

    Raises:
        OSError: the disk is full.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if size <= IN_MEMORY:
        return np.empty(shape, dtype)
    with tempfile.TemporaryFile() as file:
        # Reserved now: a full disk is an error here, where writing to the map later would kill the process.
        os.posix_fallocate(file.fileno(), 0, size) if hasattr(os, "posix_fallocate") else file.truncate(size)
        return np.memmap(file, dtype, "r+", shape=shape)


def stacked(count: int, shapes: Iterable[FloatArray]) -> FloatArray:
    """Stack shapes (V, 3) into one array (count, V, 3), so that only one shape at a time is needed in memory."""
    array: FloatArray = np.zeros(0)
    for k, shape in enumerate(shapes):
        if k == 0:
            array = room((count, *shape.shape))
        array[k] = shape
    return array


def some_vertices(vertices: FloatArray, chosen: IntArray) -> FloatArray:
    """Return the chosen vertices (k,) of all shapes (n, V, 3)."""
    if len(chosen) == vertices.shape[1]:
        return vertices
    return stacked(len(vertices), (shape[chosen] for shape in vertices))


def columns(count: int, size: int) -> Iterator[slice]:
    """Divide an array (count, size) into blocks of columns that fit into memory."""
    width = max(1, TOGETHER // count)
    return (slice(start, start + width) for start in range(0, size, width))
