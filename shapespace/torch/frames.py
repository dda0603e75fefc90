"""Vertices from lengths and angles by face frames: `FrameIntegration` for batches, with gradients."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.frame_integration import FramePlan
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.solve.substructuring import Substructures
from shapespace.torch.arrays import ArrayModule, SparseProduct, tiny

#: In the product p q, component k of p multiplies these components of q, with these signs.
PRODUCT = ((0, 1, 2, 3), (1, 0, 3, 2), (2, 3, 0, 1), (3, 2, 1, 0))
SIGNS = ((1, 1, 1, 1), (-1, 1, -1, 1), (-1, 1, 1, -1), (-1, -1, 1, 1))


class LaplaceSolve(ArrayModule):
    """Solution of a Laplace equation by `Substructures`, with right-hand sides and solutions in slots."""

    blocks: Tensor
    separator: Tensor
    means: Tensor

    def __init__(self, parts: Substructures, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        self.keep("blocks", parts.blocks)
        self.keep("separator", parts.separator)
        self._to_separator = SparseProduct(parts.coupling, dtype)
        self._to_blocks = SparseProduct(parts.coupling.T.tocsr(), dtype)

    def forward(self, right: Tensor) -> Tensor:
        """Solve for right-hand sides (n, slots, 3), up to a constant on each connected component."""
        count, width, _ = self.blocks.shape
        inner = count * width
        given = right[:, inner:]
        if not inner:
            return self._on_separator(given)
        alone = self._on_blocks(right[:, :inner])
        between = self._on_separator(given + self._to_separator(alone))
        return torch.cat([alone + self._on_blocks(self._to_blocks(between)), between], dim=1)

    def _on_blocks(self, x: Tensor) -> Tensor:
        count, width, _ = self.blocks.shape
        # Codes and coordinates as rows of one matrix for each block.
        rows = x.unflatten(1, (count, width)).permute(1, 0, 3, 2).reshape(count, -1, width)
        found = (rows @ self.blocks).reshape(count, -1, 3, width)
        return found.permute(1, 0, 3, 2).reshape(-1, count * width, 3)

    def _on_separator(self, x: Tensor) -> Tensor:
        return (x.transpose(1, 2) @ self.separator).transpose(1, 2)


class FrameVertices(ArrayModule):
    """Lengths and angles (n, 2E) → vertices in slots (n, slots, 3); see `FrameIntegration` for the method.

    Attributes:
        slots: (V,) the slot of each vertex.
    """

    face_sides: Tensor
    root_frames: Tensor
    left_sides: Tensor
    right_sides: Tensor
    tree: Tensor
    direction: Tensor
    permutations: Tensor
    signs: Tensor
    conjugate: Tensor
    hinges: Tensor
    others: Tensor
    left: Tensor
    right: Tensor
    turn_slots: Tensor
    places: Tensor

    def __init__(self, plan: FramePlan, reference: TriangleMesh, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        connectivity = reference.connectivity
        count = len(connectivity.faces)
        # Faces have the order of the plan in all arrays.
        order = plan.order
        place = order.argsort()

        def sides(found: IntArray) -> IntArray:
            side, face = divmod(found, count)
            return side * count + place[face]

        self._faces = count
        self.keep("face_sides", connectivity.face_sides[:, order].ravel())
        self.keep("root_frames", plan.root_frames)
        self.keep("left_sides", sides(plan.left_sides))
        self.keep("right_sides", sides(plan.right_sides))
        self.keep("tree", plan.tree)
        self.keep("direction", np.concatenate([np.ones((1, len(plan.tree))), np.tile(plan.direction, (3, 1))]))
        self.keep("permutations", np.ravel(PRODUCT))
        self.keep("signs", np.ravel(SIGNS)[:, None].astype(float))
        self.keep("conjugate", np.array([[1.0], [-1.0], [-1.0], [-1.0]]))
        self.keep("hinges", connectivity.edge_count + connectivity.hinge_edges)
        self._firsts = [first for first, _ in plan.rounds]
        for k, (_, ancestors) in enumerate(plan.rounds):
            self.keep(f"ancestors{k}", ancestors)
        positions = Substructures.of(*plan.positions)
        divergence = plan.divergence.tocsc()
        by_side = [divergence[:, side * count + order] for side in range(3)]
        # The sides of a face sum up to zero, so two of them are enough.
        shorter = sparse.hstack([by_side[1] - by_side[0], by_side[2] - by_side[0]])
        self._divergence = SparseProduct(in_slots(shorter, positions.unknowns), dtype)
        self._positions = LaplaceSolve(positions, dtype)
        self.slots, self.slot_count = positions.slots, len(positions.unknowns)
        self._means = None
        if positions.components.max(initial=0):
            # The alignment removes one translation; several components keep their places relative to each other.
            empty = positions.unknowns < 0
            components = np.where(empty, -1, positions.components[positions.unknowns])
            self._means = ComponentMeans(components, dtype)
            self.keep("places", _component_means(reference.vertices, positions.components)[components])
        self._turned = len(plan.others) > 0
        if self._turned:
            left, right = connectivity.edge_faces[connectivity.hinge_edges[plan.others]].T
            self.keep("others", plan.others)
            self.keep("left", place[left])
            self.keep("right", place[right])
            rotations = Substructures.of(*plan.rotations)
            self._misfits = SparseProduct(in_slots(plan.misfits, rotations.unknowns), dtype)
            self._rotations = LaplaceSolve(rotations, dtype)
            self.keep("turn_slots", rotations.slots[order])
            self._turn_mean = ComponentMeans(rotations.components[order], dtype)

    def forward(self, z: Tensor) -> Tensor:
        """Compute vertices in slots, up to a translation."""
        a, b, side = z.index_select(1, self.face_sides).unflatten(1, (3, self._faces)).split(1, dim=1)
        cosine = (b * b + side * side - a * a) / (2 * b * side)
        sin_0, cos_0 = _half(cosine)
        sin_1, cos_1 = _half((a * a + side * side - b * b) / (2 * a * side))
        one = torch.ones_like(sin_0)
        halves = torch.cat([torch.cat([sin_1, -sin_0, one], 2), torch.cat([cos_1, cos_0, 0 * one], 2)], dim=1)
        q = self._frames(halves, z.index_select(1, self.hinges)[:, None] / 2)
        # The first two axes of each frame, (n, 3, F).
        w, x, y, n = q.split(1, dim=1)
        first = torch.cat([1 - 2 * (y * y + n * n), 2 * (x * y + w * n), 2 * (x * n - w * y)], dim=1)
        second = torch.cat([2 * (x * y - w * n), 1 - 2 * (x * x + n * n), 2 * (y * n + w * x)], dim=1)
        along, across = -b * cosine.clamp(-1.0, 1.0), -2 * b * sin_0 * cos_0
        vectors = torch.cat([along * first + across * second, side * first], dim=2)
        x = self._positions(self._divergence(vectors.transpose(1, 2)))
        return x if self._means is None else self._means.without(x) + self.places

    def _frames(self, halves: Tensor, angles: Tensor) -> Tensor:
        """Compute unit quaternions (n, 4, F) of the face frames; see `FrameIntegration`."""
        a, b = halves.index_select(2, self.left_sides).split(1, dim=1)
        d, c = halves.index_select(2, self.right_sides).split(1, dim=1)
        cosine, sine = torch.cos(angles), torch.sin(angles)
        across = torch.cat(
            [
                cosine * (b * d - a * c),
                -sine * (a * c + b * d),
                sine * (a * d - b * c),
                cosine * (-b * c - a * d),
            ],
            dim=1,
        )
        q = across.index_select(2, self.tree) * self.direction
        roots = self.root_frames.expand(q.shape[0], -1, -1)
        q = torch.cat([roots, q], dim=2)
        for k, first in enumerate(self._firsts):
            moved = self._product(q.index_select(2, self.get_buffer(f"ancestors{k}")), q[:, :, first:])
            q = torch.cat([q[:, :, :first], moved], dim=2)
        return self._fitting(q, across) if self._turned else q

    def _fitting(self, frames: Tensor, across: Tensor) -> Tensor:
        """Rotate frames that agree along the tree, so that all hinges agree in least squares."""
        arrived = self._product(frames.index_select(2, self.left), across.index_select(2, self.others))
        missed = self._product(arrived, frames.index_select(2, self.right) * self.conjugate)
        scalar, vector = missed.split([1, 3], dim=1)
        # The rotation vectors are twice these, and the quaternion of a turn has half a rotation vector.
        vector = torch.sign(scalar) * vector
        turns = self._rotations(self._misfits(vector.transpose(1, 2))).index_select(1, self.turn_slots)
        turns = self._turn_mean.without(turns).transpose(1, 2)
        scale = (1 + (turns * turns).sum(dim=1, keepdim=True)).rsqrt()
        return self._product(torch.cat([scale, scale * turns], dim=1), frames)

    def _product(self, p: Tensor, q: Tensor) -> Tensor:
        """Multiply quaternions (n, 4, k): the sum, over the components of p, of signed permutations of q."""
        images = (q.index_select(1, self.permutations) * self.signs).unflatten(1, (4, 4))
        return (p[:, :, None] * images).sum(dim=1)


class ComponentMeans(ArrayModule):
    """Means over the connected components of k points; points without a component have the label −1."""

    members: Tensor
    component: Tensor

    def __init__(self, components: IntArray, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        members = (components == np.arange(components.max() + 1)[:, None]).astype(float)
        self.keep("members", members / members.sum(axis=1, keepdims=True))
        self._single = len(members) == 1
        if not self._single:
            self.keep("component", np.maximum(components, 0))

    def forward(self, x: Tensor) -> Tensor:
        """Return for each point (n, k, 3) the mean of its component; (n, 1, 3) if there is only one."""
        means = self.members @ x
        return means if self._single else means.index_select(1, self.component)

    def without(self, x: Tensor) -> Tensor:
        """Subtract these means."""
        return x - self(x)


def in_slots(matrix: sparse.csr_array, unknowns: IntArray) -> sparse.csr_array:
    """Return the rows of a matrix in the order of slots; rows of empty slots are zero."""
    rows = matrix[np.maximum(unknowns, 0)]
    return rows.multiply((unknowns >= 0).astype(float)[:, None]).tocsr()


def _component_means(points: FloatArray, components: IntArray) -> FloatArray:
    """Compute the mean (c, 3) of each component of points (k, 3)."""
    return np.stack([points[components == label].mean(axis=0) for label in range(components.max() + 1)])


def _half(cosine: Tensor) -> tuple[Tensor, Tensor]:
    """Compute sine and cosine of half the angle in [0, π] with a given cosine; beyond ±1 the angle is 0 or π."""
    least = tiny(cosine)
    return ((1 - cosine) / 2).clamp(least, 1.0).sqrt(), ((1 + cosine) / 2).clamp(least, 1.0).sqrt()
