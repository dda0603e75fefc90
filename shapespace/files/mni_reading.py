"""Reader of MNI's OBJ, the surfaces of CIVET and BrainBrowser. Only its extension is the one of Wavefront's OBJ.

The text holds, separated by blanks: ``P``, five numbers on the look of the surface, the number of points; the points,
their normals, the number of polygons; how many colours there are (0: one, 1: one for each polygon, 2: one for each
point) and the colours; for each polygon the end of its corners, and then the corners of all polygons, from 0.
(https://www.bic.mni.mcgill.ca/users/mishkin/mni_obj_format.pdf)
"""

from __future__ import annotations

import re
import warnings

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits
from shapespace.mesh.triangle_mesh import MeshError

#: The start of polygons, and of lines, as text; and of binary files.
_POLYGONS, _LINES, _BINARY = (
    re.compile(start)
    for start in (rb"\s*P(?=(?:\s+[-+\d.]\S*){6}\s)", rb"\s*L\s+[\d.]+\s+\d+\s", rb"[pl][^\r\n]{0,40}\0")
)
#: Numbers on the look of the surface, before the number of points.
_LOOK = 5


def is_mni(start: bytes) -> bool:
    """Return whether a file that begins like this is of MNI's format."""
    return any(kind.match(start) for kind in (_POLYGONS, _LINES, _BINARY))


def read_mni(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of polygons in MNI's format.

    Raises:
        MeshError: the file holds lines, is binary, or is larger than the limits.
        ValueError: the file is damaged, or cut short.
    """
    head = _POLYGONS.match(data)
    if not head:
        kind = "lines" if _LINES.match(data) else "binary data"
        raise MeshError(f"it is MNI's OBJ with {kind}, which can't be read: save polygons as text")
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # NumPy's word for text among the numbers
        try:
            numbers = np.fromstring(str(data[head.end() :], "ascii"), np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            raise ValueError(
                "text stands among the numbers of MNI's OBJ: it has several objects, or is damaged"
            ) from None
    place = 0

    def take(count: int) -> FloatArray:
        nonlocal place
        if not 0 <= count <= len(numbers) - place:
            raise ValueError("the file ends before the MNI OBJ data that it announces")
        place += count
        return numbers[place - count : place]

    take(_LOOK)
    points = int(take(1)[0])
    limits.check(points, 0)
    vertices = take(3 * points).reshape(-1, 3).copy()
    take(3 * points)
    polygons = int(take(1)[0])
    take(4 * {0: 1, 1: polygons, 2: points}.get(int(take(1)[0]), 1))
    ends = take(polygons).astype(np.int64)
    sizes = np.diff(ends, prepend=0)
    if (sizes < 3).any():
        raise ValueError("a polygon of MNI's OBJ has fewer than three corners")
    limits.check(0, int(sizes.sum()) - 2 * polygons)
    corners = take(int(sizes.sum())).astype(np.int64)
    # Triangles from polygons, which have their first corner in common.
    fans = sizes - 2
    first = np.repeat(ends - sizes, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    return vertices, corners[np.stack([first, first + step + 1, first + step + 2], axis=1)]
