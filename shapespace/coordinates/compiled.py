"""The inner loops of reconstruction, compiled by Numba where it is installed.

NumPy goes through all edges once for each operation, and at a thousand vertices most of that is overhead. A compiled
loop does all operations of an edge at once. The results are those of the NumPy code beside it up to rounding: of
`nric`, `normal_matrix`, `frame_integration` and `integrability`, which say what is computed and why. Machine code is
kept on disk (Numba's cache), so that only the first process compiles; without the GIL, so that threads run side by
side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from shapespace.arrays import FloatArray, IntArray

Vector = Sequence[float] | FloatArray
Function = TypeVar("Function", bound=Callable[..., Any])
#: Which code computes: ``auto`` takes the compiled loops where Numba is installed.
Kernels = Literal["auto", "numpy", "compiled"]

AVAILABLE = find_spec("numba") is not None


def are_used(kernels: Kernels) -> bool:
    """Whether a choice means the compiled loops."""
    return AVAILABLE if kernels == "auto" else kernels == "compiled"


if AVAILABLE and not TYPE_CHECKING:
    from numba import njit, types
    from numba.core.caching import InTreeCacheLocator

    class BesideTheModule(InTreeCacheLocator):
        """Numba's cache beside this module, also where nothing can be written: of an image that was built with it.

        NUMBA_CACHE_LOCATOR_CLASSES names it.
        """

        def ensure_cache_path(self) -> None:
            """See numba.core.caching; it would pass over a folder that can only be read."""
            with suppress(OSError):
                super().ensure_cache_path()

    _NUMBERS = {"f": types.float64, "i": types.int64, "j": types.int32}

    def _types(arguments: str) -> tuple[types.Type, ...]:
        """Of arguments such as ``f2 i``: an array (n, k) of floating point numbers, then an integer."""
        kinds = [(_NUMBERS[word[0]], int(word[1:] or 0)) for word in arguments.split()]
        return tuple(types.Array(number, ndim, "C", readonly=True) if ndim else number for number, ndim in kinds)

    def _loops(arguments: str = "") -> Callable[[Function], Function]:
        # Divisions by zero give infinity, as NumPy's do: who calls looks at what is finite.
        options = {"nogil": True, "error_model": "numpy"}
        if not arguments:
            return njit(inline="always", **options)

        def compiling(function: Function) -> Function:
            # At once, as servers don't let themselves write files later.
            try:
                return njit([_types(arguments)], cache=True, **options)(function)
            except (RuntimeError, OSError):  # no folder can be written to: every process compiles for itself
                return njit([_types(arguments)], **options)(function)

        return compiling
else:

    def _loops(arguments: str = "") -> Callable[[Function], Function]:
        return lambda function: function


@_loops()
def _cross(a: Vector, b: Vector) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_loops()
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_loops()
def _between(x: FloatArray, tail: int, head: int) -> tuple[float, float, float]:
    return x[head, 0] - x[tail, 0], x[head, 1] - x[tail, 1], x[head, 2] - x[tail, 2]


@_loops()
def _product(p: Vector, q: Vector) -> tuple[float, float, float, float]:
    """Of two quaternions."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@_loops("f2 i2 i2 i1 f1 f1")
def misfit(
    x: FloatArray, edges: IntArray, hinges: IntArray, hinge_edges: IntArray, target: FloatArray, squared: FloatArray
) -> tuple[FloatArray, float]:
    """``z(X) − z*`` (2E,), angles modulo 2π, and its squared norm.

    Args:
        x: (V, 3) vertices.
        edges: (E, 2).
        hinges: (H, 4) tail, head, left and right vertex of each interior edge.
        hinge_edges: (H,) interior edges.
        target: (2E,) z*.
        squared: (2E,) weights of the norm.
    """
    count = len(edges)
    found = -target
    for i in range(count):
        d = _between(x, edges[i, 0], edges[i, 1])
        found[i] += np.sqrt(_dot(d, d))
    for h in range(len(hinges)):
        edge = _between(x, hinges[h, 0], hinges[h, 1])
        left, right = _between(x, hinges[h, 0], hinges[h, 2]), _between(x, hinges[h, 0], hinges[h, 3])
        normal, other = _cross(edge, left), _cross(right, edge)
        # Never −0, for which the angle of a hinge folded flat would be −π.
        sine = -np.sqrt(_dot(edge, edge)) * _dot(normal, right) + 0.0
        found[count + hinge_edges[h]] += np.arctan2(sine, _dot(normal, other))
    energy = 0.0
    for i in range(count):
        energy += squared[i] * found[i] ** 2
    for i in range(count, 2 * count):
        found[i] -= 2 * np.pi * np.rint(found[i] / (2 * np.pi))
        energy += squared[i] * found[i] ** 2
    return found, energy


@_loops("f2 i2 i2")
def gradients(x: FloatArray, edges: IntArray, hinges: IntArray) -> tuple[FloatArray, FloatArray]:
    """(E, 3) derivatives of lengths by heads, and (H, 12) of angles by tail, head, left and right vertex."""
    lengths, angles = np.empty((len(edges), 3)), np.empty((len(hinges), 12))
    for i in range(len(edges)):
        d = _between(x, edges[i, 0], edges[i, 1])
        length = np.sqrt(_dot(d, d))
        for k in range(3):
            lengths[i, k] = d[k] / length
    for h in range(len(hinges)):
        edge = _between(x, hinges[h, 0], hinges[h, 1])
        to_left, to_right = _between(x, hinges[h, 0], hinges[h, 2]), _between(x, hinges[h, 0], hinges[h, 3])
        normal, other = _cross(edge, to_left), _cross(to_right, edge)
        square = _dot(edge, edge)
        length = np.sqrt(square)
        by_left, by_right = -length / _dot(normal, normal), -length / _dot(other, other)
        along_left, along_right = _dot(to_left, edge) / square, _dot(to_right, edge) / square
        for k in range(3):
            left, right = by_left * normal[k], by_right * other[k]
            head = -along_left * left - along_right * right
            angles[h, k] = -(head + left + right)
            angles[h, 3 + k], angles[h, 6 + k], angles[h, 9 + k] = head, left, right
    return lengths, angles


@_loops("f2 f2 i2 i2 i1 i f1")
def pull_back(
    lengths: FloatArray,
    angles: FloatArray,
    edges: IntArray,
    hinges: IntArray,
    hinge_edges: IntArray,
    count: int,
    covector: FloatArray,
) -> FloatArray:
    """``Jᵀ p`` (V, 3) of a covector (2E,), J given by `gradients`."""
    out = np.zeros((count, 3))
    for i in range(len(edges)):
        for k in range(3):
            value = covector[i] * lengths[i, k]
            out[edges[i, 0], k] -= value
            out[edges[i, 1], k] += value
    for h in range(len(hinges)):
        p = covector[len(edges) + hinge_edges[h]]
        for corner in range(4):
            for k in range(3):
                out[hinges[h, corner], k] += p * angles[h, 3 * corner + k]
    return out


@_loops("f2 f2 i1 f1 j2 j2 i")
def normal_entries(
    lengths: FloatArray,
    angles: FloatArray,
    hinge_edges: IntArray,
    squared: FloatArray,
    of_lengths: IntArray,
    of_angles: IntArray,
    size: int,
) -> FloatArray:
    """Entries (size,) of the upper triangle of ``JᵀWJ``, J given by `gradients`.

    Args:
        lengths: (E, 3), see `gradients`.
        angles: (H, 12).
        hinge_edges: (H,) interior edges.
        squared: (2E,) weights W.
        of_lengths: (E, 21) the entry of each product of derivatives of a length, in the order of `NormalMatrix`: tail
            with tail and head with head, of both the upper triangle, then tail with head.
        of_angles: (H, 78) the same of angles, the upper triangle.
        size: number of entries.
    """
    out = np.zeros(size)
    for i in range(len(lengths)):
        upper, whole = 0, 12
        for a in range(3):
            weighted = squared[i] * lengths[i, a]
            for b in range(3):
                value = weighted * lengths[i, b]
                out[of_lengths[i, whole]] -= value
                whole += 1
                if b >= a:
                    out[of_lengths[i, upper]] += value
                    out[of_lengths[i, 6 + upper]] += value
                    upper += 1
    for h in range(len(angles)):
        weight, slot = squared[len(lengths) + hinge_edges[h]], 0
        for a in range(12):
            weighted = weight * angles[h, a]
            for b in range(a, 12):
                out[of_angles[h, slot]] += weighted * angles[h, b]
                slot += 1
    return out


@_loops()
def _half(cosine: float) -> tuple[float, float]:
    """Cosine and sine of half the angle with this cosine, which is moved into [−1, 1] first."""
    if cosine > 1:
        cosine = 1.0
    elif cosine < -1:
        cosine = -1.0
    return np.sqrt((1 + cosine) / 2), np.sqrt((1 - cosine) / 2)


@_loops("f1 i2")
def planes(z: FloatArray, face_edges: IntArray) -> FloatArray:
    """(F, 10) of each triangle in its own plane, corner 0 at the origin, corner 1 on the first axis.

    Cosines of half the directions of its sides, their sines, then the two coordinates of corner 2, the length of side
    2, and 0.
    """
    out = np.zeros((len(face_edges), 10))
    for f in range(len(face_edges)):
        a, b, side = z[face_edges[f, 0]], z[face_edges[f, 1]], z[face_edges[f, 2]]
        cosine = (b * b + side * side - a * a) / (2 * b * side)
        cos_0, sin_0 = _half(cosine)
        cos_1, sin_1 = _half((a * a + side * side - b * b) / (2 * a * side))
        out[f, 0], out[f, 1], out[f, 2] = sin_1, -sin_0, 1.0
        out[f, 3], out[f, 4], out[f, 5] = cos_1, cos_0, 0.0
        out[f, 6] = b * (2 * cos_0 * cos_0 - 1)
        out[f, 7] = 2 * b * sin_0 * cos_0
        out[f, 8] = side
    return out


@_loops("f2 f1 i2 i1 i1 i1 f1 f2")
def frames(
    halves: FloatArray,
    angles: FloatArray,
    sides: IntArray,
    order: IntArray,
    parents: IntArray,
    tree: IntArray,
    direction: FloatArray,
    roots: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """(F, 4) unit quaternions of the face frames along the tree, and (H, 4) the rotations across the hinges.

    Args:
        halves: (F, ≥ 6) of `planes`.
        angles: (H,) of the hinges.
        sides: (H, 4) the left face of each hinge and its side of it, the right face and its side.
        order: (F,) faces, each after its parent, the roots first.
        parents: (F − roots,) of the faces after the roots.
        tree: (F − roots,) hinges from the parents to these faces.
        direction: (F − roots,) −1 where that hinge leads from the face to its parent, otherwise 1.
        roots: (roots, 4) frames of the roots.
    """
    across = np.empty((len(sides), 4))
    for h in range(len(sides)):
        a, b = halves[sides[h, 0], sides[h, 1]], halves[sides[h, 0], 3 + sides[h, 1]]
        d, c = halves[sides[h, 2], sides[h, 3]], -halves[sides[h, 2], 3 + sides[h, 3]]
        cosine, sine = np.cos(angles[h] / 2), np.sin(angles[h] / 2)
        across[h, 0] = cosine * (a * c + b * d)
        across[h, 1] = sine * (a * c - b * d)
        across[h, 2] = sine * (b * c + a * d)
        across[h, 3] = cosine * (b * c - a * d)
    q, local = np.empty((len(order), 4)), np.empty(4)
    for k in range(len(roots)):
        q[order[k]] = roots[k]
    for k in range(len(tree)):
        local[0] = across[tree[k], 0]
        for i in range(1, 4):
            local[i] = direction[k] * across[tree[k], i]
        face = order[len(roots) + k]
        q[face, 0], q[face, 1], q[face, 2], q[face, 3] = _product(q[parents[k]], local)
    return q, across


@_loops("f2 f2 i1 i2 f1")
def misfits(q: FloatArray, across: FloatArray, others: IntArray, sides: IntArray, weights: FloatArray) -> FloatArray:
    """(3, F) right-hand sides of the rotations that make frames fit at the hinges (n,) outside the tree.

    Args:
        q: (F, 4) see `frames`.
        across: (H, 4) see `frames`.
        others: (n,) those hinges.
        sides: (H, 4) see `frames`.
        weights: (n,) of them.
    """
    right, back = np.zeros((3, len(q))), np.empty(4)
    for k in range(len(others)):
        h = others[k]
        left_face, right_face = sides[h, 0], sides[h, 2]
        back[0] = q[right_face, 0]
        for i in range(1, 4):
            back[i] = -q[right_face, i]
        missed = _product(_product(q[left_face], across[h]), back)
        # A quaternion and its negative are the same rotation: the one by less than half a turn is meant.
        sign = np.copysign(2 * weights[k], missed[0])
        right[0, left_face] -= sign * missed[1]
        right[1, left_face] -= sign * missed[2]
        right[2, left_face] -= sign * missed[3]
        right[0, right_face] += sign * missed[1]
        right[1, right_face] += sign * missed[2]
        right[2, right_face] += sign * missed[3]
    return right


@_loops("f2 f2")
def turned(q: FloatArray, turns: FloatArray) -> FloatArray:
    """(F, 4) frames q, each rotated a little more, by the vectors (3, F)."""
    out, turn = np.empty_like(q), np.empty(4)
    for f in range(len(q)):
        x, y, z = turns[0, f] / 2, turns[1, f] / 2, turns[2, f] / 2
        size = np.sqrt(1 + x * x + y * y + z * z)
        turn[0], turn[1], turn[2], turn[3] = 1 / size, x / size, y / size, z / size
        out[f, 0], out[f, 1], out[f, 2], out[f, 3] = _product(turn, q[f])
    return out


@_loops("f2 f2 i2 f2 f2")
def divergence(
    q: FloatArray, triangles: FloatArray, faces: IntArray, weights: FloatArray, anchored: FloatArray
) -> FloatArray:
    """(3, V) right-hand sides of the Poisson equation for vertices.

    Args:
        q: (F, 4) face frames.
        triangles: (F, 10) of `planes`.
        faces: (F, 3).
        weights: (3, F) of the sides of all faces.
        anchored: (V, 3) what is added.
    """
    right = anchored.T.copy()
    side = np.empty((3, 3))
    for f in range(len(q)):
        w, x, y, n = q[f, 0], q[f, 1], q[f, 2], q[f, 3]
        first = (1 - 2 * (y * y + n * n), 2 * (x * y + w * n), 2 * (x * n - w * y))
        second = (2 * (x * y - w * n), 1 - 2 * (x * x + n * n), 2 * (y * n + w * x))
        for i in range(3):
            side[2, i] = triangles[f, 8] * first[i]
            side[1, i] = -triangles[f, 6] * first[i] - triangles[f, 7] * second[i]
            side[0, i] = -side[1, i] - side[2, i]
        for k in range(3):
            tail, head = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            for i in range(3):
                value = weights[k, f] * side[k, i]
                right[i, tail] -= value
                right[i, head] += value
    return right


@_loops("f1 i2 i2 i1")
def closing(z: FloatArray, face_edges: IntArray, fans: IntArray, crossed: IntArray) -> FloatArray:
    """(n, 3) closing conditions at interior vertices.

    Args:
        z: (2E,).
        face_edges: (F, 3).
        fans: (k, n) corners around each vertex in order, −1 once a fan is complete.
        crossed: (3F,) the edge over which each corner is left.
    """
    count = len(z) // 2
    turns = np.empty((len(crossed), 4))
    for f in range(len(face_edges)):
        a, b, c = z[face_edges[f, 0]] ** 2, z[face_edges[f, 1]] ** 2, z[face_edges[f, 2]] ** 2
        sums = (b + c - a, c + a - b, a + b - c)
        area = max(sums[0] * a + sums[1] * b + sums[2] * c, 0.0)
        for k in range(3):
            size = np.sqrt(max(sums[k] ** 2 + area, np.finfo(np.float64).tiny))
            cos_z, sin_z = _half(sums[k] / size)
            half = z[count + crossed[3 * f + k]] / 2
            cos_x, sin_x = np.cos(half), np.sin(half)
            turns[3 * f + k, 0], turns[3 * f + k, 1] = cos_z * cos_x, -cos_z * sin_x
            turns[3 * f + k, 2], turns[3 * f + k, 3] = -sin_z * sin_x, sin_z * cos_x
    out, q = np.empty((fans.shape[1], 3)), np.empty(4)
    for vertex in range(fans.shape[1]):
        q[0], q[1], q[2], q[3] = 1.0, 0.0, 0.0, 0.0
        for k in range(len(fans)):
            if fans[k, vertex] < 0:
                break
            q[0], q[1], q[2], q[3] = _product(q, turns[fans[k, vertex]])
        out[vertex] = q[1:]
    return out
