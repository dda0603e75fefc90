"""Networks of straight-line models: exact by construction, without samples and without training."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm, nric, unwrap
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.solve.substructuring import Substructures
from shapespace.torch.arrays import ArrayModule, SparseProduct
from shapespace.torch.frames import LaplaceSolve, in_slots
from shapespace.training.learning.combiners.combiner import CombinerNetwork
from shapespace.training.learning.combiners.sums import SumCorrection
from shapespace.training.learning.composite import Composite
from shapespace.training.learning.layers import Scaling
from shapespace.training.learning.networks import ShapeNetwork, predict
from shapespace.training.runs.network_settings import SumSettings
from shapespace.training.space.face_coordinates import (
    PER_FACE,
    FaceCoordinates,
    symmetric_matrices,
)
from shapespace.training.space.straight_collection import StraightCollection


class LinearNetwork(nn.Module):
    """Codes (n, m) → an affine function of them, in the shape of its value at the code 0."""

    mean: Tensor
    modes: Tensor

    def __init__(self, mean: FloatArray, modes: FloatArray) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32))
        self.register_buffer("modes", torch.tensor(modes.reshape(len(modes), -1), dtype=torch.float32))

    def forward(self, latent: Tensor) -> Tensor:
        return self.mean + (latent @ self.modes).unflatten(1, self.mean.shape)


class LengthsAndAngles(nn.Module):
    """Vertices (n, V, 3) → their lengths and angles (n, 2E), as in coordinates.nric."""

    edges: Tensor
    hinges: Tensor
    slots: Tensor

    def __init__(self, connectivity: Connectivity) -> None:
        super().__init__()
        self.register_buffer("edges", torch.tensor(np.asarray(connectivity.edge_ends)))
        self.register_buffer("hinges", torch.tensor(np.asarray(connectivity.hinge_corners)))
        # For each edge its hinge, or a zero behind all hinges.
        slots = np.full(connectivity.edge_count, len(connectivity.hinge_edges))
        slots[connectivity.hinge_edges] = np.arange(len(connectivity.hinge_edges))
        self.register_buffer("slots", torch.as_tensor(slots))

    def forward(self, vertices: Tensor) -> Tensor:
        tail, head = (vertices[:, ends] for ends in self.edges)
        lengths = (head - tail).square().sum(dim=2).sqrt()
        tail, head, left, right = (vertices[:, corners] for corners in self.hinges)
        edge, to_right = head - tail, right - tail
        left_normal, right_normal = _cross(edge, left - tail), _cross(to_right, edge)
        sine = -(left_normal * to_right).sum(dim=2) * edge.square().sum(dim=2).sqrt()
        cosine = (left_normal * right_normal).sum(dim=2)
        # Half the angle, by operators with derivatives in every program that reads the file. A flat fold has no sign.
        size = (sine.square() + cosine.square()).sqrt()
        angles = 2 * torch.atan(sine / (cosine + size + 1e-30))
        return torch.cat([lengths, nn.functional.pad(angles, (0, 1))[:, self.slots]], dim=1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Return cross products (n, k, 3). The operator of the same name has no counterpart in ONNX."""
    (x, y, z), (u, v, w) = a.unbind(dim=2), b.unbind(dim=2)
    return torch.stack([y * w - z * v, z * u - x * w, x * v - y * u], dim=2)


class VerticesFromFaces(ArrayModule):
    """Rotations and stretches of faces (n, F, 9) → vertices (n, V, 3), as `FaceCoordinates.shape`."""

    sides: Tensor
    matrices: Tensor
    slots: Tensor

    def __init__(self, coordinates: FaceCoordinates) -> None:
        super().__init__(torch.float32)
        plan = coordinates.integration.plan
        positions = Substructures.of(*plan.positions)
        self._divergence = SparseProduct(in_slots(plan.divergence, positions.unknowns), torch.float32)
        self._positions = LaplaceSolve(positions, torch.float32)
        self.keep("slots", positions.slots)
        self.keep("sides", np.moveaxis(coordinates.sides, 0, 2))  # (F, 3, 3), a side in each column
        self.keep("matrices", symmetric_matrices())

    def forward(self, faces: Tensor) -> Tensor:
        turn, stretch = faces.split([3, PER_FACE - 3], dim=2)
        sides = self.sides + (stretch @ self.matrices).unflatten(2, (3, 3)) @ self.sides
        # The quaternion (w, v) of a rotation takes x to ``x + 2 w v × x + 2 v × (v × x)``.
        half = ((turn * turn).sum(dim=2, keepdim=True) + 1e-12).sqrt() / 2
        scalar, vector = torch.cos(half)[..., None], (torch.sin(half) / (2 * half) * turn)[..., None]
        once = _cross(vector, sides)
        turned = sides + 2 * (scalar * once + _cross(vector, once))
        found: Tensor = self._positions(self._divergence(turned.permute(0, 3, 1, 2).flatten(1, 2)))
        return found.index_select(1, self.slots)


class StraightNetwork(ShapeNetwork):
    """Codes (n, m) → NRIC (n, 2E): linear, or the lengths and angles of vertices from linear coordinates."""

    def __init__(self, *steps: nn.Module) -> None:
        super().__init__()
        self.steps = nn.Sequential(*steps)

    def forward(self, latent: Tensor) -> Tensor:
        found: Tensor = self.steps(latent)
        return found


def straight_composite(collection: StraightCollection) -> Composite:
    """Return the composite of a straight-line model: one factor, and a combiner that changes nothing."""
    lines, reference = collection.lines, collection.reference
    measure = LengthsAndAngles(reference.connectivity)
    if lines.kind == "vertices":
        network = StraightNetwork(LinearNetwork(reference.vertices, lines.modes), measure)
    elif lines.kind == "differential":
        line = LinearNetwork(lines.mean.reshape(-1, PER_FACE), lines.modes)
        network = StraightNetwork(line, VerticesFromFaces(lines.differential), measure)
    else:
        network = StraightNetwork(LinearNetwork(lines.mean, lines.modes))
    own = nric(reference.vertices, reference.connectivity)
    shapes = predict(network, torch.as_tensor(lines.coefficients, dtype=torch.float32)).numpy()
    scaling = Scaling.of(own, WeightedNorm.of(reference, eta=1.0).squared, unwrap(shapes, own))
    combiner = CombinerNetwork(scaling, SumSettings(), SumCorrection({}), {})
    index = list(range(len(lines)))
    return Composite([index], [network.eval()], combiner.eval())


def straight_start(collection: StraightCollection) -> LinearNetwork:
    """Return the start network: vertices that move along straight lines."""
    return LinearNetwork(collection.reference.vertices, collection.lines.fields)
