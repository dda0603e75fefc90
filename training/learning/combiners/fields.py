"""Neural fields on the edges of the mesh, for features that move over the surface.

The perceptron is the same at every edge, and gets the position of each feature relative to the edge. Convolutions have
to find this position from the factor shapes around an edge, through many layers. Kernels in patches have to learn it
anew for every place.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.correction import Correction, JointSamples, Motion
from shapespace.training.learning.linear import regression
from shapespace.training.runs.network_settings import FieldSettings, FitSettings

#: Share of the edges of a training step that are drawn uniformly. The affine sum's error chooses the others.
UNIFORM = 0.5
#: Highest frequency of the waves on the surface that read codes.
ORDER = 4


class FieldCorrection(Correction):
    """Perceptron that corrects the affine sum at each edge, by the positions of features relative to this edge.

    Its inputs at an edge are functions of the angle ``r`` from each coordinate's place there to the code. These are
    ``cos r``, ``sin r``, and for each concentration κ the density of von Mises' distribution, ``exp(κ (cos r − 1))``,
    and its derivative. Further inputs are the lengths and angles of the factors and of the reference at this edge, and
    the edge's constants. So symmetries that move codes and places together need not be learned.

    The combiner's only input are the factor shapes, so codes are read from these: the cosine and the sine of a
    coordinate by a linear map of its factor's shape.

    ``places`` (E, m) is the angle at which each coordinate is at an edge, and ``constants`` (E, c) are constants of
    each edge. ``factor_count`` is J, and ``rest`` (E, 2) is `JointSamples.rest`.
    """

    owner: Tensor
    reader: Tensor
    offset: Tensor
    places: Tensor
    edges: Tensor

    def __init__(
        self, settings: FieldSettings, rest: Tensor, factor_count: int, places: Tensor, constants: Tensor
    ) -> None:
        super().__init__({})
        self.settings = settings
        count, m = places.shape
        self.register_buffer("owner", torch.zeros(m, dtype=torch.long))
        self.register_buffer("reader", torch.zeros(m, 2 * count, 2))
        self.register_buffer("offset", torch.zeros(m, 2))
        self.register_buffer("places", places)
        self.register_buffer("edges", torch.cat([rest, constants], dim=1))
        inputs = 2 * m * (1 + len(settings.concentrations)) + 2 * factor_count + self.edges.shape[1]
        widths = [inputs] + [settings.width] * settings.layers
        layers: list[nn.Module] = []
        for a, b in itertools.pairwise(widths):
            layers += [nn.Linear(a, b), nn.SiLU()]
        self.perceptron = nn.Sequential(*layers, nn.Linear(widths[-1], 2))
        # Training starts from the affine sum.
        for parameter in self.perceptron[-1].parameters():
            nn.init.zeros_(parameter)

    @classmethod
    def fit(
        cls, settings: FieldSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> FieldCorrection:
        """Return the untrained network with a fitted code reader; see `Correction`. Raises ValueError if the collection
        does not know where features move.
        """
        if own.motion is None or held_out.motion is None:
            raise ValueError('kind = "field" needs a collection that knows where its coordinates are on the surface')
        places = own.motion.places
        angles, constants = places.angles, places.constants
        if not settings.relative:
            angles, constants = 0 * angles, np.concatenate([constants, np.cos(angles), np.sin(angles)], axis=1)
        edges = (torch.as_tensor(values, dtype=torch.float32) for values in (angles, constants))
        result = cls(settings, own.rest, own.factors.shape[1], *edges)
        waves = _waves(torch.as_tensor(places.surface, dtype=torch.float32))
        for j, index in enumerate(own.latents):
            result.owner[index] = j
            pairs = (_reading(s, m, j, index, waves) for s, m in ((own, own.motion), (held_out, held_out.motion)))
            result._fit_reader(index, waves, *pairs)
        return result

    @classmethod
    def load(cls, settings: FieldSettings, reference: TriangleMesh, tensors: Mapping[str, Tensor]) -> FieldCorrection:
        places, edges = tensors["places"], tensors["edges"]
        known = edges.shape[1] + 2 * places.shape[1] * (1 + len(settings.concentrations))
        factor_count = (tensors["perceptron.0.weight"].shape[1] - known) // 2
        result = cls(settings, edges[:, :2], factor_count, places, edges[:, 2:])
        result.load_state_dict(tensors)
        return result

    @property
    def descent(self) -> FitSettings:
        return self.settings.fit

    def _fit_reader(
        self, index: list[int], waves: Tensor, own: tuple[Tensor, Tensor], held_out: tuple[Tensor, Tensor]
    ) -> None:
        """Fit the map that reads the latents of a factor, to pairs of `_reading`."""
        mean, spread = own[0].mean(dim=0), own[0].std(dim=0).clamp_min(1e-6)

        def features(sums: Tensor) -> Tensor:
            return torch.cat([torch.ones_like(sums[:, :1]), (sums - mean) / spread], dim=1)

        weights = regression(features(own[0]), own[1], (features(held_out[0]), held_out[1])).weights.float()
        slope = weights[1:] / spread[:, None]
        reader = waves @ slope.view(2, waves.shape[1], -1)
        self.reader[index] = reader.flatten(0, 1).unflatten(1, (-1, 2)).transpose(0, 1)
        self.offset[index] = (weights[0] - mean @ slope).view(-1, 2)

    def codes(self, y: Tensor) -> Tensor:
        """Return the cosine and sine (n, m, 2) of each coordinate, read from the factor shapes (n, J, 2E)."""
        read = (y[:, self.owner, None] @ self.reader)[:, :, 0] + self.offset
        return read / read.square().sum(dim=2, keepdim=True).clamp_min(1e-12).sqrt()

    def _features(self, y: Tensor, edges: Tensor | None = None) -> Tensor:
        """Return inputs (n, K, C) of the perceptron at edges (n, K), or at all edges."""
        n, j, double = y.shape
        at, constants, shapes = self.places, self.edges, y.view(n, 2 * j, double // 2)
        if edges is not None:
            at, constants, shapes = at[edges], constants[edges], shapes.take_along_dim(edges[:, None], dim=2)
        else:
            constants = constants.expand(n, -1, -1)
        cosine, sine = self.codes(y)[:, None].unbind(dim=3)
        c = cosine * torch.cos(at) + sine * torch.sin(at)
        s = sine * torch.cos(at) - cosine * torch.sin(at)
        parts = [c, s]
        for concentration in self.settings.concentrations:
            density = torch.exp(concentration * (c - 1))
            parts += [density, concentration**0.5 * s * density]
        return torch.cat([*parts, shapes.transpose(1, 2), constants], dim=2)

    def difference(self, y: Tensor) -> Tensor:
        return self.perceptron(self._features(y)).transpose(1, 2).flatten(1)

    def loss(self, y: Tensor, target: Tensor) -> Tensor:
        """Estimate the mean square error, without bias, on some edges of each shape; the affine sum chooses them."""
        missed = (target - y.sum(dim=1)).unflatten(1, (2, -1))
        error, count = missed.square().sum(dim=1), missed.shape[2]
        share = error / error.sum(dim=1, keepdim=True).clamp_min(1e-30)
        chance = (1 - UNIFORM) * share + UNIFORM / count
        edges = torch.multinomial(chance, self.settings.edges, replacement=True)
        weight = 1 / (count * chance.gather(1, edges))
        wanted = missed.take_along_dim(edges[:, None], dim=2).transpose(1, 2)
        return ((self.perceptron(self._features(y, edges)) - wanted).square().mean(dim=2) * weight).mean()


def _waves(surface: Tensor) -> Tensor:
    """Return products (E, w) of waves of the surface's angles (E, d), each with frequencies up to `ORDER`."""
    result = torch.ones_like(surface[:, :1])
    for angle in surface.T:
        multiples = angle[:, None] * torch.arange(1, ORDER + 1)
        waves = torch.cat([torch.ones_like(angle[:, None]), torch.cos(multiples), torch.sin(multiples)], dim=1)
        result = (result[:, :, None] * waves[:, None]).flatten(1)
    return result


def _reading(samples: JointSamples, motion: Motion, j: int, index: list[int], waves: Tensor) -> tuple[Tensor, Tensor]:
    """Return features (n, 2 w) and targets (n, 2 m_j) of the code reader of factor j.

    Features are sums of the factor's shape over edges, weighted by waves. A map of all its entries would know a
    feature only at the places that occur in some sample. Targets are cosines and sines of the latents.
    """
    angles = motion.codes[:, index]
    y = samples.scaling.down(samples.factors[: len(angles), j])
    return (y.unflatten(1, (2, -1)) @ waves).flatten(1), torch.stack(
        [torch.cos(angles), torch.sin(angles)], dim=2
    ).flatten(1)
