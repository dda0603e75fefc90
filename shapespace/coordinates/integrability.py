"""When lengths and angles are those of a surface: the closing conditions Q(z) = 0.

Walk around an interior vertex with a face frame: x along the current edge, z along the face's normal. Each corner
rotates it by the inner angle γ about z, each edge by the dihedral angle θ about x. Back at the start the frame
must be what it was (paper, appendix C, after Wang, Liu and Tong 2012, with quaternions as Sassen et al.
2019). The rotations add up to 2π where the surface is flat, so the product of the unit quaternions is −1 there
and stays near it at every integrable z; its vector part is the condition: three numbers a vertex.

On a simply connected surface that is all. Every handle, and every boundary loop but the first, leaves loops
that no vertices fill; along them the frame must come back in direction *and* in place: six numbers a loop.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates import quaternions
from shapespace.mesh.triangle_mesh import Connectivity


class _Move(NamedTuple):
    """One motion of a face frame along a loop: a rotation by an inner or dihedral angle, or a slide along an edge."""

    kind: str
    parameter: int
    sign: float


class Integrability:
    """The conditions Q and their Jacobian on a connectivity.

    Q has three entries for each interior vertex, in vertex order, then six (rotation, translation) for each
    of the ``2g + b − 1`` loops (2g on a closed surface) that generate what vertices leave open.

    DQ has as many independent rows as make its kernel, on the angles of interior edges and all lengths, the
    (3V − 6)-dimensional tangent space of immersed meshes; on a closed surface six rows are redundant.
    """

    def __init__(self, connectivity: Connectivity) -> None:
        self.connectivity = connectivity
        faces, f_count = connectivity.faces, len(connectivity.faces)
        # Corner c = 3 f + k; walking around its vertex, one leaves face f over the side opposite to corner k + 1.
        k = np.tile(np.arange(3), f_count)
        f = np.repeat(np.arange(f_count), 3)
        self._exit: IntArray = connectivity.face_edges[f, (k + 1) % 3]
        other = connectivity.edge_faces[self._exit].sum(axis=1) - f
        entry = np.argmax(faces[other] == faces.ravel()[:, None], axis=1)
        following = np.where(connectivity.interior[self._exit], 3 * other + entry, -1)

        boundary = np.unique(connectivity.edges[~connectivity.interior])
        self.vertices: IntArray = np.setdiff1d(np.arange(connectivity.vertex_count), boundary)
        """The interior vertices."""
        first = np.zeros(connectivity.vertex_count, dtype=np.int64)
        first[faces.ravel()] = np.arange(3 * f_count)
        fans = [first[self.vertices]]
        while True:
            after = np.where(fans[-1] >= 0, following[fans[-1]], -1)
            after[after == fans[0]] = -1
            if (after < 0).all():
                break
            fans.append(after)
        #: (n, interior vertices): corners around each vertex, −1 once the fan is complete.
        self._fans = np.stack(fans)
        self._loops = [_moves(connectivity, crossing) for crossing in _generators(connectivity)]

    def __call__(self, z: FloatArray) -> FloatArray:
        """Q(z) (n,); zero where z (2E,) belongs to an immersed surface. Finite for all finite z."""
        gamma = self._angles(z)
        loops = [self._around(moves, gamma, z)[0] for moves in self._loops]
        return np.concatenate([self.at_vertices(z).ravel(), *loops])

    def at_vertices(self, z: FloatArray) -> FloatArray:
        """Q(z) at the interior vertices, (n, 3): as long as the sine of half the angle left after a turn around."""
        cos_gamma, theta = self._cosines(z), z[self.connectivity.edge_count :]
        cos_z, sin_z = np.sqrt((1 + cos_gamma) / 2), np.sqrt((1 - cos_gamma) / 2)
        cos_x, sin_x = (f(theta / 2).take(self._exit) for f in (np.cos, np.sin))
        # By a corner's angle about z, then back by its edge's about x; an identity where a fan is complete.
        turns = np.zeros((4, len(cos_gamma) + 1))
        turns[:, :-1] = cos_z * cos_x, -cos_z * sin_x, -sin_z * sin_x, sin_z * cos_x
        turns[0, -1] = 1
        return quaternions.chain(turns.take(self._fans, axis=1))[1:].T

    def jacobian(self, z: FloatArray) -> sparse.csr_array:
        """DQ(z) (n, 2E)."""
        gamma, theta = self._angles(z), z[self.connectivity.edge_count :]
        by_length = self._angle_derivatives(z)
        e, n = self.connectivity.edge_count, len(self.vertices)
        before, axes = quaternions.identity(n), []
        for turn_z, turn_x in self._turns(gamma, theta):
            before = quaternions.product(before, turn_z)
            axes.append((quaternions.axis(before, 2), -quaternions.axis(before, 0)))
            before = quaternions.product(before, turn_x)
        scalar, vector = before[0], before[1:]

        rows, columns, values = [], [], []

        def add(row: IntArray, column: IntArray, value: FloatArray) -> None:
            for i in range(3):
                rows.append(3 * row + i)
                columns.append(column)
                values.append(value[i])

        vertex = np.arange(n)
        for corners, axis_pair in zip(self._fans, axes, strict=True):
            there = corners >= 0
            c = corners[there]
            # d(product) = (axis/2) · product: half of w a + a × p in the vector part.
            by_gamma, by_theta = (0.5 * (scalar * a + np.cross(a, vector, axis=0))[:, there] for a in axis_pair)
            add(vertex[there], e + self._exit[c], by_theta)
            for side in range(3):
                edge = self.connectivity.face_edges[c // 3, side]
                add(vertex[there], edge, by_gamma * by_length[c, side])
        matrix = sparse.csr_array(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(3 * n, 2 * e)
        )
        loops = [self._around_derivative(moves, gamma, by_length, z) for moves in self._loops]
        return sparse.csr_array(sparse.vstack([matrix, *map(sparse.csr_array, loops)]))

    def _corners(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``c`` (3, F), ``S`` (F,): 2 l_j l_k cos γ_i = c_i, 2 l_j l_k sin γ_i = √S; impossible triangles are flat."""
        q = z.take(self.connectivity.face_sides) ** 2
        c = q.sum(axis=0) - 2 * q
        return c, np.maximum((c * q).sum(axis=0), 0)

    def _angles(self, z: FloatArray) -> FloatArray:
        """(3F,) inner angles of all corners, from lengths."""
        c, S = self._corners(z)
        gamma: FloatArray = np.arctan2(np.sqrt(S), c).T.ravel()
        return gamma

    def _cosines(self, z: FloatArray) -> FloatArray:
        """(3F,) cosines of the inner angles, in a fifth of the time that angles and their cosines take."""
        c, S = self._corners(z)
        cosines: FloatArray = (c / np.sqrt(np.maximum(c * c + S, np.finfo(float).tiny))).T.ravel()
        return cosines

    def _angle_derivatives(self, z: FloatArray) -> FloatArray:
        """(3F, 3): derivative of each inner angle by the three lengths of its face."""
        lengths = z[: self.connectivity.edge_count][self.connectivity.face_edges]
        gamma = self._angles(z).reshape(-1, 3)
        height = lengths[:, 1] * np.sin(gamma[:, 2])  # over side 0
        area = lengths[:, 0] * height / 2
        out = np.empty((len(gamma), 3, 3))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            slope = lengths[:, i] / (2 * area)
            out[:, i, i] = slope
            out[:, i, j] = -slope * np.cos(gamma[:, k])
            out[:, i, k] = -slope * np.cos(gamma[:, j])
        return out.reshape(-1, 3)

    def _turns(self, gamma: FloatArray, theta: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """The quaternions of every corner and edge around the vertices; identities once a fan is complete."""
        turns = []
        for corners in self._fans:
            there = corners >= 0
            turn_z = np.where(there, gamma[corners], 0.0)
            turn_x = np.where(there, -theta[self._exit[corners]], 0.0)
            turns.append((quaternions.turn(turn_z, 2), quaternions.turn(turn_x, 0)))
        return turns

    def _around(
        self, moves: list[_Move], gamma: FloatArray, z: FloatArray
    ) -> tuple[FloatArray, float, list[tuple[FloatArray, FloatArray]]]:
        """The six conditions of a loop, the product's scalar part, and the twist (ω, v) of each move."""
        e = self.connectivity.edge_count
        rotation, place = quaternions.identity(1), np.zeros(3)
        twists = []
        for kind, parameter, sign in moves:
            if kind == "slide":
                direction = quaternions.axis(rotation, 0)[:, 0]
                twists.append((np.zeros(3), direction))
                place = place + z[parameter] * direction
                rotation = quaternions.product(rotation, quaternions.turn(np.array([np.pi]), 2))
                continue
            axis = 2 if kind == "corner" else 0
            angle = gamma[parameter] if kind == "corner" else z[e + parameter]
            direction = sign * quaternions.axis(rotation, axis)[:, 0]
            twists.append((direction, np.cross(place, direction)))
            rotation = quaternions.product(rotation, quaternions.turn(np.array([sign * angle]), axis))
        return np.concatenate([rotation[1:, 0], place]), float(rotation[0, 0]), twists

    def _around_derivative(
        self, moves: list[_Move], gamma: FloatArray, by_length: FloatArray, z: FloatArray
    ) -> FloatArray:
        """(6, 2E): a twist (ω, v) moves the end place p by v + ω × p and the product by (ω/2) · product."""
        e = self.connectivity.edge_count
        end, scalar, twists = self._around(moves, gamma, z)
        vector, place = end[:3], end[3:]
        derivative = np.zeros((6, 2 * e))
        for (kind, parameter, _), (omega, v) in zip(moves, twists, strict=True):
            turned = 0.5 * (scalar * omega + np.cross(omega, vector))
            column = np.concatenate([turned, v + np.cross(omega, place)])
            if kind == "corner":
                derivative[:, self.connectivity.face_edges[parameter // 3]] += column[:, None] * by_length[parameter]
            else:
                derivative[:, parameter + (e if kind == "edge" else 0)] += column
        return derivative


def _generators(connectivity: Connectivity) -> list[list[int]]:
    """Loops that generate what interior vertices leave of the fundamental group, as corners to walk through.

    Tree and cotree: a spanning tree over faces, then one over vertices (all boundary vertices as one) that
    crosses none of its edges; each interior edge in neither tree closes one loop through the tree over
    faces. A loop is given as alternating faces and edges crossed.
    """
    inner = connectivity.hinge_edges
    parent: dict[int, tuple[int, int]] = {0: (-1, -1)}
    by_face: dict[int, list[int]] = {}
    for edge in inner.tolist():
        for face in connectivity.edge_faces[edge].tolist():
            by_face.setdefault(face, []).append(edge)
    used, queue = set(), deque([0])
    while queue:
        face = queue.popleft()
        for edge in by_face.get(face, []):
            a, b = connectivity.edge_faces[edge].tolist()
            other = b if a == face else a
            if other not in parent:
                parent[other] = (face, edge)
                used.add(edge)
                queue.append(other)

    group = np.arange(connectivity.vertex_count)
    boundary = np.unique(connectivity.edges[~connectivity.interior])
    if len(boundary):
        group[boundary] = boundary[0]
    root = list(range(connectivity.vertex_count))

    def find(vertex: int) -> int:
        while root[vertex] != vertex:
            root[vertex] = root[root[vertex]]
            vertex = root[vertex]
        return vertex

    loops = []
    for edge in inner.tolist():
        if edge in used:
            continue
        i, j = (find(int(group[v])) for v in connectivity.edges[edge])
        if i != j:
            root[i] = j
            continue
        a, b = connectivity.edge_faces[edge].tolist()
        to_a, to_b = _ascent(parent, a), _ascent(parent, b)
        while len(to_a) > 1 and len(to_b) > 1 and to_a[-2:] == to_b[-2:]:
            to_a, to_b = to_a[:-2], to_b[:-2]
        # Both end at the common ancestor: from it to a, over the edge, and up from b.
        loops.append([*to_a[::-1], edge, *to_b[:-1]])
    return loops


def _ascent(parent: dict[int, tuple[int, int]], face: int) -> list[int]:
    """Face, edge, face, … up to the root of the tree."""
    out = [face]
    while parent[face][0] >= 0:
        face, edge = parent[face]
        out += [edge, face]
    return out


def _moves(connectivity: Connectivity, loop: list[int]) -> list[_Move]:
    """The motions of a face frame along a loop of alternating faces and edges.

    The frame's origin is a vertex, its x axis runs along an edge. In each face it slides to the edge's other
    end if need be, turns to the next edge there, and tips over into the next face.
    """
    faces, crossed = loop[::2], loop[1::2]
    edges = connectivity.edges
    start = origin = int(edges[crossed[-1], 0])
    moves = []
    for face, entered, left in zip(faces, [crossed[-1], *crossed[:-1]], crossed, strict=True):
        if origin not in edges[left]:
            moves.append(_Move("slide", entered, 1))
            origin = int(edges[entered].sum()) - origin
        k = connectivity.faces[face].tolist().index(origin)
        ahead = int(edges[entered].sum()) - origin == connectivity.faces[face, (k + 1) % 3]
        sign = 1.0 if ahead else -1.0
        moves.append(_Move("corner", 3 * face + k, sign))
        moves.append(_Move("edge", left, -sign))
    if origin != start:
        moves.append(_Move("slide", crossed[-1], 1))
    return moves
