"""Products and lengths of many vectors in space.

Arrays are (…, 3), or (3, …) where a name says *by components*: whole arrays of x, y and z are several times faster to
compute with than rows of three.
"""

import numpy as np

from shapespace.arrays import FloatArray


def components(vertices: FloatArray) -> FloatArray:
    """Copy vectors (…, V, 3) to components (3, …, V), contiguous."""
    return np.ascontiguousarray(vertices.T if vertices.ndim == 2 else np.moveaxis(vertices, -1, 0))


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Scalar products (…) of vectors by components (3, …)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Vector products (3, …) of vectors by components (3, …), in a third of the time of ``np.cross``.

    For vectors (…, 3) it is ``cross(a.T, b.T).T``.
    """
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=out[i])
        out[i] -= a[k] * b[j]
    return out


def dots(a: FloatArray, b: FloatArray) -> FloatArray:
    """Scalar products (…) of vectors (…, n)."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def unit(vectors: FloatArray) -> FloatArray:
    """Scale vectors (…, 3) to length 1; zero vectors stay zero.

    >>> unit(np.array([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]])).tolist()
    [[0.0, 0.6, 0.8], [0.0, 0.0, 0.0]]
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1))
