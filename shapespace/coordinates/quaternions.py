"""Unit quaternions as rotations, by components (4, …), scalar part first."""

import numpy as np

from shapespace.arrays import FloatArray


def identity(n: int) -> FloatArray:
    """Return n identities (4, n)."""
    return turn(np.zeros(n), 0)


def turn(angle: FloatArray, axis: int) -> FloatArray:
    """Return rotations (4, n) by angles (n,) about a coordinate axis."""
    out = np.zeros((4, len(angle)))
    out[0], out[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return out


def product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Compute the product p q (4, …)."""
    w, x, y, z = p
    a, b, c, d = q
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
    )


def conjugate(q: FloatArray) -> FloatArray:
    """Invert rotations (4, n)."""
    return q * np.array([[1], [-1], [-1], [-1]])


def chain(q: FloatArray) -> FloatArray:
    """Multiply k quaternions each, (4, k, n), in order, to (4, n): neighbours first, then their products."""
    while q.shape[1] > 1:
        even = q.shape[1] - q.shape[1] % 2
        q = np.concatenate([product(q[:, 0:even:2], q[:, 1:even:2]), q[:, even:]], axis=1)
    return q[:, 0]


def axis(q: FloatArray, index: int) -> FloatArray:
    """Rotate a coordinate axis by each of n rotations, (3, n)."""
    unit = np.zeros_like(q)
    unit[1 + index] = 1
    return product(product(q, unit), conjugate(q))[1:]
