"""Fine meshes, alignment and misfits of batches of shapes."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import WeightedNorm, edge_lengths
from shapespace.mesh.fine_detail import FineDetail
from shapespace.mesh.prolongation import Prolongation, faces_at_vertices
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.torch.arrays import ArrayModule, SparseProduct, norm, tiny

#: Share of the second eigenvector that may remain in the best rotation, for shapes like the reference.
SECOND = 1e-18
#: Fewest and most squarings of the matrix whose first eigenvector is the best rotation.
SQUARINGS = (10, 18)


class CrossProduct(ArrayModule):
    """Cross products of vectors (n, 3, k)."""

    before: Tensor
    after: Tensor

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        self.keep("after", np.array([1, 2, 0]))
        self.keep("before", np.array([2, 0, 1]))

    def forward(self, u: Tensor, v: Tensor) -> Tensor:
        """Return ``u × v``."""
        after, before = self.after, self.before
        ahead = u.index_select(1, after) * v.index_select(1, before)
        return ahead - u.index_select(1, before) * v.index_select(1, after)


class RigidAlignment(ArrayModule):
    """Rigid alignment of points (n, k, 3) to a target (k, 3) in least squares, as `mesh.rigid_motion.align`.

    The best rotation is, as a quaternion, the first eigenvector of a symmetric matrix (Horn 1987). Its entries, as
    those of the rotation, are products of two components of the quaternion. Repeated squaring gives all these products
    without a case distinction. Runtimes have no singular value decomposition.
    """

    target: Tensor
    centre: Tensor
    quadratic: Tensor
    quarter: Tensor

    def __init__(self, target: FloatArray, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        self.keep("centre", target.mean(axis=0))
        self.keep("target", target - target.mean(axis=0))
        self.keep("quadratic", _rotation_entries().reshape(9, 16))
        self.keep("quarter", np.eye(4) / 4)
        values = np.linalg.svd((target - target.mean(axis=0)).T @ (target - target.mean(axis=0)), compute_uv=False)
        shift = math.sqrt(3 * (values**2).sum())
        first, second = values.sum() + shift, values[0] - values[1] - values[2] + shift
        needed = math.log2(math.log(SECOND) / math.log(second / first)) if second < first else SQUARINGS[1]
        self._squarings = int(np.clip(2 * math.ceil(needed / 2), *SQUARINGS))

    def rotation(self, moments: Tensor) -> Tensor:
        """Return the best rotations (n, 3, 3), for rows, of points with moments ``Σ x yᵀ`` (n, 3, 3)."""
        flat = moments.flatten(1)
        shift = math.sqrt(3) * norm(flat, 1) + tiny(flat)
        power = (flat @ self.quadratic / (4 * shift)).unflatten(1, (4, 4)) + self.quarter
        for _ in range(self._squarings // 2):
            square = power @ power
            # The trace of the square of a symmetric matrix.
            power = square @ square / (square * square).sum(dim=(1, 2), keepdim=True)
        return (power.flatten(1) @ self.quadratic.T).unflatten(1, (3, 3))

    def forward(self, points: Tensor) -> Tensor:
        """Align the points."""
        x = points - points.mean(dim=1, keepdim=True)
        return x @ self.rotation(x.transpose(1, 2) @ self.target) + self.centre


class RigidPartAlignment(RigidAlignment):
    """A part of the fine mesh that keeps its form: its rest shape, aligned to points (n, k, 3)."""

    def forward(self, points: Tensor) -> Tensor:
        """Align the rest shape to the points."""
        centre = points.mean(dim=1, keepdim=True)
        moments = (points - centre).transpose(1, 2) @ self.target
        return self.target @ self.rotation(moments).transpose(1, 2) + centre


class DetailDisplacements(RigidAlignment):
    """Displacements (n, Vf, 3) of fine vertices for coarse vertices (n, V, 3); see `FineDetail`."""

    axes: Tensor
    fields: Tensor

    def __init__(self, detail: FineDetail, dtype: torch.dtype) -> None:
        super().__init__(detail.rest, dtype)
        self.keep("axes", detail.axes.reshape(len(detail.axes), -1).T)
        self.keep("fields", detail.fields.reshape(len(detail.fields), -1))

    def forward(self, points: Tensor) -> Tensor:
        """Return the displacements."""
        x = points - points.mean(dim=1, keepdim=True)
        rotation = self.rotation(x.transpose(1, 2) @ self.target)
        coordinates = (x @ rotation - self.target).flatten(1) @ self.axes
        return (coordinates @ self.fields).unflatten(1, (-1, 3)) @ rotation.transpose(1, 2)


class FineVertices(ArrayModule):
    """Coarse vertices (n, slots, 3) → fine vertices (n, V, 3); see `Prolongation`."""

    corners: Tensor
    order: Tensor
    slots: Tensor

    def __init__(self, prolong: Prolongation, slots: IntArray, slot_count: int, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        count = len(slots)
        self.keep("corners", slots[prolong.faces].T.ravel())
        self._faces, self._cross = len(prolong.faces), CrossProduct(dtype)
        self._around = SparseProduct(faces_at_vertices(prolong.faces, count), dtype)
        on_vertices = prolong.weights[:, :count].tocoo()
        on_normals = prolong.weights[:, count:].tocoo()
        data, rows = (
            np.concatenate([getattr(part, of) for part in (on_vertices, on_normals)]) for of in ("data", "row")
        )
        columns = np.concatenate([slots[on_vertices.col], slot_count + on_normals.col])
        matrix = sparse.csr_array((data, (rows, columns)), shape=(prolong.vertex_count, slot_count + count))
        self._weights = SparseProduct(matrix, dtype)
        self._detail = None
        if prolong.detail:
            self.keep("slots", slots)
            self._detail = DetailDisplacements(prolong.detail, dtype)
        self._parts = torch.nn.ModuleList(RigidPartAlignment(part.rest, dtype) for part in prolong.rigid)
        if prolong.rigid:
            moved = np.concatenate([part.vertices for part in prolong.rigid])
            rest = np.setdiff1d(np.arange(prolong.vertex_count), moved)
            for k, part in enumerate(prolong.rigid):
                self.keep(f"part{k}", part.vertices)
            self.keep("rest", rest)
            self.keep("order", np.argsort(np.concatenate([rest, moved])))

    def forward(self, x: Tensor) -> Tensor:
        """Return the fine vertices."""
        a, b, c = x.index_select(1, self.corners).transpose(1, 2).split(self._faces, dim=2)
        normal = self._cross(b - a, c - a).transpose(1, 2)
        summed = self._around(torch.cat([normal, norm(normal, 2)], dim=2))
        direction, area = summed[:, :, :3], summed[:, :, 3:]
        scaled = direction * (area.clamp_min(tiny(area)).sqrt() / norm(direction, 2))
        fine = self._weights(torch.cat([x, scaled], dim=1))
        if self._detail is not None:
            fine = fine + self._detail(x.index_select(1, self.slots))
        if not len(self._parts):
            return fine
        parts = [fine.index_select(1, self.get_buffer("rest"))]
        parts += [part(fine.index_select(1, self.get_buffer(f"part{k}"))) for k, part in enumerate(self._parts)]
        return torch.cat(parts, dim=1).index_select(1, self.order)


class Misfit(ArrayModule):
    """Relative misfit (n,) of shapes (n, slots, 3) from lengths and angles (n, 2E): `Reconstruction.residual`."""

    corners: Tensor
    hinges: Tensor
    length_weights: Tensor
    angle_weights: Tensor

    def __init__(self, reference: TriangleMesh, eta: float, slots: IntArray, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        c: Connectivity = reference.connectivity
        squared = WeightedNorm.of(reference, eta).squared
        # Edges have length 1 on average here, so that products of lengths are far from the smallest numbers.
        self._unit = 1 / float(edge_lengths(reference.vertices, c).mean())
        # Edges and hinges begin at the same vertex.
        left, right = c.hinge_corners[2:]
        self.keep("corners", slots[np.concatenate([*c.edge_ends, c.hinge_corners[0], left, right])])
        self._sizes = [c.edge_count, c.edge_count, len(left), len(left), len(left)]
        self._all, self._cross = c.is_closed, CrossProduct(dtype)
        self.keep("hinges", c.hinge_edges)
        self.keep("length_weights", squared[: c.edge_count] / self._unit**2)
        self.keep("angle_weights", squared[c.edge_count :][c.hinge_edges])

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        """Return the misfits."""
        corners = self._unit * x.index_select(1, self.corners).transpose(1, 2)
        tail, head, origin, left, right = corners.split(self._sizes, dim=2)
        edge = head - tail
        lengths, angles = self._unit * z[:, : self._sizes[0]], z[:, self._sizes[0] :]
        length = norm(edge, 1)[:, 0]
        side, hinge_length = edge, length
        if not self._all:
            angles = angles.index_select(1, self.hinges)
            side, hinge_length = edge.index_select(2, self.hinges), length.index_select(1, self.hinges)
        arm = right - origin
        normal, other = self._cross(side, left - origin), self._cross(arm, side)
        sine, cosine = -hinge_length * (normal * arm).sum(1), (normal * other).sum(1)
        # The angle minus the one asked for, in (−π, π): its tangent's half, from the tangent of the half angle.
        there, here = torch.sin(angles), torch.cos(angles)
        y, w = sine * here - cosine * there, cosine * here + sine * there
        size = (y * y + w * w).clamp_min(tiny(y)).sqrt()
        turned = 2 * torch.atan(y / (size + w).clamp_min(tiny(y)))
        missed = (self.length_weights * (length - lengths) ** 2).sum(1) + (self.angle_weights * turned**2).sum(1)
        wanted = (self.length_weights * lengths**2).sum(1) + (self.angle_weights * angles**2).sum(1)
        return (missed / wanted).sqrt()


def _rotation_entries() -> FloatArray:
    """(3, 3, 4, 4) matrices of the entries of a rotation, for rows, as quadratic forms of its quaternion."""
    entries = np.zeros((3, 3, 4, 4))
    for i in range(3):
        for a in range(4):
            entries[i, i, a, a] = 1 if a in (0, i + 1) else -1
    for i, j in product(range(3), repeat=2):
        if i == j:
            continue
        k = 3 - i - j
        sign = 1 if (i, j) in ((0, 1), (1, 2), (2, 0)) else -1
        for a, b, value in ((i + 1, j + 1, 1), (0, k + 1, sign)):
            entries[i, j, a, b] = entries[i, j, b, a] = value
    return entries
