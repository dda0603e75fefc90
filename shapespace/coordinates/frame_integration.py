"""Vertices from lengths and angles without iterating: face frames along a spanning tree, then linear solves.

Lengths determine the form of every triangle. An angle determines the rotation between two neighbours. A spanning tree
of the faces therefore gives each face a frame, and the frame gives the vectors of its sides. The vertices that fit
these vectors best solve a Poisson equation with a fixed matrix (Lipman, Sorkine, Levin and Cohen-Or 2005). The result
is exact where z is integrable.

Elsewhere errors accumulate along each path in the tree, and frames disagree at the hinges outside the tree. Small
rotations ω of the faces spread this disagreement over all hinges. The frames of faces f and g agree where ``ω_g − ω_f``
is the rotation e_fg between them. The least squares over all hinges are a linear equation with another fixed matrix,
the Laplacian of the faces. This brings the start of Gauss–Newton two to six times closer to its result.

**Half angles.** A rotation by φ about a unit axis a is the quaternion (cos φ/2, a sin φ/2), so only half of an inner
angle γ is needed. Its cosine follows from the law of cosines, ``cos γ = (b² + c² − a²) / 2bc``. Then
``sin γ/2 = √((1 − cos γ)/2)`` and ``cos γ/2 = √((1 + cos γ)/2)``, without a trigonometric function.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates import quaternions
from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh, face_normals
from shapespace.solve.cholesky import Backend, Factorisation, SymmetricPattern, analyse


class WeightedGraph(NamedTuple):
    """Nodes, and edges with weights (n,): the Laplacian of a least-squares equation."""

    size: int
    tails: IntArray
    heads: IntArray
    weights: FloatArray


class FramePlan(NamedTuple):
    """All that `FrameIntegration` computes from the connectivity and the reference, see there.

    Side k of face f, opposite to its corner k, has the index ``k F + f``.
    """

    order: IntArray  # (F,) faces, sorted by their depth in the tree
    root_frames: FloatArray  # (4, R) frames of the first R of these faces, which are roots
    left_sides: IntArray  # (H,) the side that each hinge is of its left face
    right_sides: IntArray  # (H,) the side that each hinge is of its right face
    tree: IntArray  # (F − R,) the hinge to the parent of each other face
    direction: FloatArray  # (F − R,) 1, or −1 where the rotation at this hinge is reversed
    rounds: list[tuple[int, IntArray]]  # products along the tree: first face in the order, and ancestors there
    others: IntArray  # (O,) hinges outside the tree
    misfits: sparse.csr_array  # (F, O) right-hand side of the rotations from the misfits at these hinges
    divergence: sparse.csr_array  # (V, 3F) right-hand side of the positions from the vectors of the sides
    rotations: WeightedGraph  # left-hand side of the rotations of faces
    positions: WeightedGraph  # left-hand side of the positions of vertices


class FrameIntegration:
    """Shapes from lengths and angles (NRIC) of one connectivity, without iterating.

    The tree, the order of the products of rotations and the factors of the two matrices are computed once. An instance
    holds these factors: use one per thread.
    """

    #: Relative weight of the reference in the Poisson equation, which fixes translations, and of zero rotations in the
    #: equation of the rotations. Small enough to change nothing else.
    ANCHOR = 1e-9

    def __init__(self, reference: TriangleMesh, backend: Backend = "auto") -> None:
        c = reference.connectivity
        self._connectivity, self._count = c, len(c.faces)
        parents = _spanning_forest(reference)
        depths = _depths(parents)
        # Faces sorted by depth, the roots first, and the position of each face in this order.
        order: IntArray = np.argsort(depths, kind="stable")
        self._place = np.argsort(order)
        self._roots = int((depths == 0).sum())
        self._root_frames = _face_frames(reference, order[: self._roots])
        self._hinges(order[self._roots :], parents)
        self._rounds = _rounds(depths[order], self._place[parents[order]])
        self._poisson_equation(reference, backend)
        self._rotation_equation(reference, backend)

    @property
    def plan(self) -> FramePlan:
        """What other runtimes need to compute the same shapes."""
        return FramePlan(
            order=np.argsort(self._place),
            root_frames=self._root_frames,
            left_sides=self._left_sides,
            right_sides=self._right_sides,
            tree=self._tree,
            direction=self._direction,
            rounds=self._rounds,
            others=self._others,
            misfits=self._misfits,
            divergence=self._divergence,
            rotations=self._rotations,
            positions=self._positions,
        )

    def _hinges(self, children: IntArray, parents: IntArray) -> None:
        """Find the side that each hinge is of its two faces, and the hinge from each face to its parent."""
        c = self._connectivity
        self._left_sides, self._right_sides = (
            (c.face_edges[faces] == c.hinge_edges[:, None]).argmax(axis=1) * self._count + faces
            for faces in c.edge_faces[c.hinge_edges].T
        )
        pairs = c.edge_faces[c.hinge_edges].tolist()
        hinge_of = {(a, b): h for h, (a, b) in enumerate(pairs)} | {(b, a): h for h, (a, b) in enumerate(pairs)}
        to_parents = zip(parents[children].tolist(), children.tolist(), strict=True)
        self._tree: IntArray = np.array([hinge_of[pair] for pair in to_parents], dtype=np.int64)
        #: 1 where the parent is the left face of the edge, −1 where the rotation is reversed.
        self._direction = np.where(c.edge_faces[c.hinge_edges[self._tree], 0] == parents[children], 1.0, -1.0)
        self._others = np.setdiff1d(np.arange(len(pairs)), self._tree)

    def _poisson_equation(self, reference: TriangleMesh, backend: Backend) -> None:
        """Build the matrix of the right-hand side, and factorise the matrix of the left-hand side."""
        c = self._connectivity
        # Side k runs from corner k + 1 to corner k + 2.
        tails, heads = c.faces.T[[1, 2, 0]].ravel(), c.faces.T[[2, 0, 1]].ravel()
        weights = ((reference.vertices[heads] - reference.vertices[tails]) ** 2).sum(axis=1) ** -1.0
        self._divergence = _differences(c.vertex_count, tails, heads, weights)
        anchor = self.ANCHOR * weights.mean()
        self._anchored = anchor * reference.vertices
        self._positions = WeightedGraph(c.vertex_count, tails, heads, weights)
        self._poisson = _laplacian(self._positions, anchor, backend)

    def _rotation_equation(self, reference: TriangleMesh, backend: Backend) -> None:
        """Do the same for the small rotations of faces. An angle has its weight in the norm of lengths and angles."""
        c = self._connectivity
        left, right = c.edge_faces[c.hinge_edges].T
        weights = WeightedNorm.of(reference, 1.0).squared[c.edge_count + c.hinge_edges]
        others = self._others
        self._left, self._right = left[others], right[others]
        self._misfits = _differences(self._count, self._left, self._right, weights[others])
        self._rotations = WeightedGraph(self._count, left, right, weights)
        if len(others):
            self._laplacian = _laplacian(self._rotations, self.ANCHOR * weights.mean(), backend)

    @np.errstate(divide="ignore", over="ignore", invalid="ignore")
    def __call__(self, z: FloatArray) -> FloatArray:
        """Compute vertices (V, 3) from lengths and angles (2E,); not finite where lengths are 0 or not finite."""
        c = self._connectivity
        a, b, side = z.take(c.face_sides)
        # In the plane of a face, corner 0 is the origin and corner 1 lies on the first axis. Half angles at both.
        cosine = (b * b + side * side - a * a) / (2 * b * side)
        sin_0, cos_0 = _half(cosine)
        sin_1, cos_1 = _half((a * a + side * side - b * b) / (2 * a * side))
        # Half the directions of the sides: (π − corner 1) / 2, (π + corner 0) / 2, 0.
        halves = np.empty((2, 3, self._count))
        halves[0] = sin_1, -sin_0, np.ones_like(sin_0)
        halves[1] = cos_1, cos_0, np.zeros_like(sin_0)
        w, x, y, n = self._face_frames(halves.reshape(2, -1), z.take(c.edge_count + c.hinge_edges) / 2)
        first = np.stack([1 - 2 * (y * y + n * n), 2 * (x * y + w * n), 2 * (x * n - w * y)])
        second = np.stack([2 * (x * y - w * n), 1 - 2 * (x * x + n * n), 2 * (y * n + w * x)])
        sides = np.empty((3, 3, self._count))
        np.multiply(first, side, out=sides[:, 2])
        np.multiply(first, -b * np.clip(cosine, -1, 1), out=sides[:, 1])
        sides[:, 1] -= second * (2 * b * sin_0 * cos_0)
        np.negative(sides[:, 1], out=sides[:, 0])
        sides[:, 0] -= sides[:, 2]
        return self.positions(sides.reshape(3, -1).T)

    def positions(self, sides: FloatArray) -> FloatArray:
        """Compute the vertices (V, 3) that fit vectors of the sides (3F, 3) best; side k of face f is row k F + f."""
        right = self._divergence @ sides + self._anchored
        # One column at a time: Pardiso takes more than twice as long for three at once.
        return np.stack([self._poisson.solve(column) for column in right.T], axis=1)

    def _face_frames(self, halves: FloatArray, angles: FloatArray) -> FloatArray:
        """Unit quaternions (4, F) of the face frames. ``halves`` (2, 3F) are cosines and sines of half the directions
        of all sides, ``angles`` (H,) half the angles of the hinges.
        """
        # Across a hinge: rotate its direction α in the left face to the first axis, fold by θ, rotate the first axis to
        # its direction β in the right face, where the edge runs the other way. As quaternions this is z(α) x(θ) z(−β),
        # with (a, b) the cosine and sine of α/2, and (c, d) the cosine and sine of β/2.
        a, b = halves.take(self._left_sides, axis=1)
        d, c = halves.take(self._right_sides, axis=1)
        np.negative(c, out=c)
        cosine, sine = np.cos(angles), np.sin(angles)
        across = np.empty((4, len(angles)))
        np.multiply(cosine, a * c + b * d, out=across[0])
        np.multiply(sine, a * c - b * d, out=across[1])
        np.multiply(sine, b * c + a * d, out=across[2])
        np.multiply(cosine, b * c - a * d, out=across[3])
        q = np.empty((4, self._count))
        q[:, : self._roots] = self._root_frames
        from_parents = q[:, self._roots :]
        across.take(self._tree, axis=1, out=from_parents)
        from_parents[1:] *= self._direction
        # Products along the paths from the roots; each round doubles their length.
        for first, ancestors in self._rounds:
            q[:, first:] = quaternions.product(q.take(ancestors, axis=1), q[:, first:])
        return self._fitting(q.take(self._place, axis=1), across)

    def _fitting(self, frames: FloatArray, across: FloatArray) -> FloatArray:
        """Rotate frames (4, F) that agree along the tree a little, so that all hinges agree in least squares."""
        if not len(self._others):
            return frames
        arrived = quaternions.product(frames.take(self._left, axis=1), across.take(self._others, axis=1))
        missed = quaternions.product(arrived, quaternions.conjugate(frames.take(self._right, axis=1)))
        # A quaternion and its negative are the same rotation. Choose the sign for less than half a turn.
        vectors = 2 * missed[1:] * np.copysign(1, missed[0])
        right = self._misfits @ vectors.T
        turns = np.ones((4, self._count))
        for k, column in enumerate(right.T):
            turns[k + 1] = self._laplacian.solve(column) / 2
        turns /= np.sqrt((turns * turns).sum(axis=0))
        return quaternions.product(turns, frames)


def _differences(size: int, tails: IntArray, heads: IntArray, weights: FloatArray) -> sparse.csr_array:
    """(size, n) matrix that adds n weighted values to their heads and subtracts them from their tails."""
    places = np.concatenate([tails, heads]), np.tile(np.arange(len(tails)), 2)
    return sparse.csr_array((np.concatenate([-weights, weights]), places), shape=(size, len(tails)))


def _laplacian(graph: WeightedGraph, anchor: float, backend: Backend) -> Factorisation:
    """Factorise the Laplacian of a weighted graph, with ``anchor`` added to its diagonal."""
    size, tails, heads, weights = graph
    pattern = SymmetricPattern(size, np.concatenate([tails, heads, tails]), np.concatenate([tails, heads, heads]))
    entries = pattern.scatter(np.concatenate([weights, weights, -weights]))
    entries[pattern.diagonal] += anchor
    return analyse(pattern, backend).factorise(entries)


def _spanning_forest(mesh: TriangleMesh) -> IntArray:
    """Parents (F,) of the faces in trees of shortest paths from a central face of each component; a root is its own.

    The length of a step is the distance between the centres of the two faces, plus the mean distance over all hinges:
    each hinge adds an error, even a short one.
    """
    c, centres = mesh.connectivity, mesh.vertices[mesh.faces].mean(axis=1)
    left, right = c.edge_faces[c.hinge_edges].T
    steps = np.linalg.norm(centres[left] - centres[right], axis=1)
    steps += steps.mean()
    graph = sparse.csr_array((steps, (left, right)), shape=(len(centres), len(centres)))
    parts = connected_components(graph, directed=False)[1]
    roots = np.array([_middle(graph, np.flatnonzero(parts == part)) for part in range(parts.max() + 1)])
    _, predecessors, _ = dijkstra(graph, directed=False, indices=roots, min_only=True, return_predecessors=True)
    parents: IntArray = predecessors.astype(np.int64)
    parents[roots] = roots
    return parents


def _depths(parents: IntArray) -> IntArray:
    """Steps (F,) from each face to its root."""
    depths: IntArray = np.zeros(len(parents), dtype=np.int64)
    ancestors: IntArray = np.arange(len(parents))
    while (parents[ancestors] != ancestors).any():
        depths += parents[ancestors] != ancestors
        ancestors = parents[ancestors]
    return depths


def _rounds(depths: IntArray, parents: IntArray) -> list[tuple[int, IntArray]]:
    """Plan the products along all paths from the roots, in as many rounds as the depth has binary digits.

    Each round multiplies the product of every face by the product of its ancestor, which doubles the length of the path
    ("pointer jumping", Wyllie 1979). A round is the first face that takes part, and the ancestors of this face and all
    later faces.
    """
    rounds, ancestors, reach = [], parents, 1
    while reach <= depths[-1]:
        first = int(np.searchsorted(depths, reach))
        rounds.append((first, ancestors[first:]))
        ancestors, reach = ancestors[ancestors], 2 * reach
    return rounds


def _half(cosine: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sine and cosine of half the angle in [0, π] with a given cosine, which is clipped to [−1, 1]."""
    cosine = np.clip(cosine, -1, 1)
    return np.sqrt((1 - cosine) / 2), np.sqrt((1 + cosine) / 2)


def _middle(graph: sparse.csr_array, part: IntArray) -> int:
    """Find a central face of a component: half way between two faces that are far apart."""
    far = part[0]
    distances = []
    for _ in range(3):
        distances.append(dijkstra(graph, directed=False, indices=far)[part])
        far = part[distances[-1].argmax()]
    return int(part[np.maximum(distances[-1], distances[-2]).argmin()])


def _face_frames(mesh: TriangleMesh, faces: IntArray) -> FloatArray:
    """(4, n) quaternions that rotate the axes to face frames: along side 2, across it, and along the normal."""
    corners = mesh.vertices[mesh.faces[faces]]
    along = corners[:, 1] - corners[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = face_normals(mesh.vertices, mesh.faces[faces])
    matrices = np.stack([along, np.cross(normal, along), normal], axis=2)
    return Rotation.from_matrix(matrices).as_quat(scalar_first=True).T
