"""Networks of straight-line models: exact by construction, without samples and without training."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm, nric, unwrap
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.training.learning.combiners.combiner import CombinerNetwork
from shapespace.training.learning.combiners.sums import SumCorrection
from shapespace.training.learning.composite import Composite
from shapespace.training.learning.layers import Scaling
from shapespace.training.learning.networks import ShapeNetwork, predict
from shapespace.training.runs.network_settings import SumSettings
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


class StraightNetwork(ShapeNetwork):
    """Codes (n, m) → NRIC (n, 2E): linear, or the lengths and angles of linear vertices."""

    def __init__(self, line: LinearNetwork, measure: LengthsAndAngles | None) -> None:
        super().__init__()
        self.line, self.measure = line, measure

    def forward(self, latent: Tensor) -> Tensor:
        found: Tensor = self.line(latent)
        return found if self.measure is None else self.measure(found)


def straight_composite(collection: StraightCollection) -> Composite:
    """Return the composite of a straight-line model: one factor, and a combiner that changes nothing."""
    lines, reference = collection.lines, collection.reference
    if lines.kind == "vertices":
        line = LinearNetwork(reference.vertices, lines.modes)
        network = StraightNetwork(line, LengthsAndAngles(reference.connectivity))
    else:
        network = StraightNetwork(LinearNetwork(lines.mean, lines.modes), None)
    own = nric(reference.vertices, reference.connectivity)
    shapes = predict(network, torch.as_tensor(lines.coefficients, dtype=torch.float32)).numpy()
    scaling = Scaling.of(own, WeightedNorm.of(reference, eta=1.0).squared, unwrap(shapes, own))
    combiner = CombinerNetwork(scaling, SumSettings(), SumCorrection({}), {})
    index = list(range(len(lines)))
    return Composite([index], [network.eval()], combiner.eval())


def straight_start(collection: StraightCollection) -> LinearNetwork:
    """Return the start network: vertices that move along straight lines."""
    return LinearNetwork(collection.reference.vertices, collection.lines.fields)
