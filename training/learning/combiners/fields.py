"""Neural fields on the edges of the mesh, for features that move over the surface.

The perceptron is the same at every edge and sees where each feature lies to it. Convolutions have to find that out from
the factors' shapes around an edge, by way of many layers; kernels in patches have to learn it anew for every place.
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
from shapespace.training.runs.config import FieldSettings, FitSettings

#: Share of the edges of a training step that are drawn uniformly; the others in proportion to the affine sum's error.
UNIFORM = 0.5
#: Highest frequency of the waves on the surface that codes are read by.
ORDER = 4


class FieldCorrection(Correction):
    """A perceptron that adds to the affine sum at each edge, by where features lie to this edge.

    Its inputs at an edge are functions of the angle ``r`` from each coordinate's place there to the code: ``cos r``,
    ``sin r``, and for each concentration κ the density of von Mises' distribution, ``exp(κ (cos r − 1))``, and its
    derivative; the lengths and angles of the factors and of the reference at this edge; and the edge's constants.
    So symmetries that move codes and places alike need not be learned.

    The combiner's input are the factors' shapes and nothing else, so codes are read from these: the cosine and the sine
    of a coordinate by a linear map of its factor's shape.

    Args:
        settings: of the network.
        rest: (E, 2) lengths and angles of the reference, each with mean 0 and variance 1.
        factor_count: J.
        places: (E, m) angles, where each coordinate is at an edge.
        constants: (E, c) of each edge.
    """

    owner: Tensor
    reader: Tensor
    offset: Tensor
    places: Tensor
    edges: Tensor

    def __init__(
        self, settings: FieldSettings, rest: Tensor, factor_count: int, places: Tensor, constants: Tensor
    ) -> None:
        super().__init__()
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
        """The untrained network, which can read codes; see `Correction`.

        Raises:
            ValueError: nothing is known of where features move.
        """
        if own.motion is None or held_out.motion is None:
            raise ValueError('kind = "field" needs a collection that knows where its coordinates are on the surface')
        places, rest = own.motion.places, own.scaling.mean.view(2, -1).T
        rest = (rest - rest.mean(dim=0)) / rest.std(dim=0).clamp_min(1e-6)
        angles, constants = places.angles, places.constants
        if not settings.relative:
            angles, constants = 0 * angles, np.concatenate([constants, np.cos(angles), np.sin(angles)], axis=1)
        result = cls(
            settings,
            rest,
            own.factors.shape[1],
            torch.as_tensor(angles, dtype=torch.float32),
            torch.as_tensor(constants, dtype=torch.float32),
        )
        waves = _waves(torch.as_tensor(places.surface, dtype=torch.float32))
        for j, index in enumerate(own.latents):
            result.owner[index] = j
            pairs = (_reading(s, m, j, index, waves) for s, m in ((own, own.motion), (held_out, held_out.motion)))
            result._fit_reader(index, waves, *pairs)
        return result

    @classmethod
    def load(cls, settings: FieldSettings, reference: TriangleMesh, tensors: Mapping[str, Tensor]) -> FieldCorrection:
        """See `Correction`; sizes are those of the tensors."""
        places, edges = tensors["places"], tensors["edges"]
        known = edges.shape[1] + 2 * places.shape[1] * (1 + len(settings.concentrations))
        factor_count = (tensors["perceptron.0.weight"].shape[1] - known) // 2
        result = cls(settings, edges[:, :2], factor_count, places, edges[:, 2:])
        result.load_state_dict(tensors)
        return result

    @property
    def descent(self) -> FitSettings:
        """How the perceptron is trained; what reads codes is fitted."""
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
        """(n, m, 2) cosine and sine of each coordinate, read from the factors' shapes (n, J, 2E)."""
        read = (y[:, self.owner, None] @ self.reader)[:, :, 0] + self.offset
        return read / read.square().sum(dim=2, keepdim=True).clamp_min(1e-12).sqrt()

    def _features(self, y: Tensor, edges: Tensor | None = None) -> Tensor:
        """(n, K, C) inputs of the perceptron at edges (n, K), or at all."""
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
        """An unbiased estimate of the mean square error from some edges of each shape, chosen by the affine sum."""
        missed = (target - y.sum(dim=1)).unflatten(1, (2, -1))
        error, count = missed.square().sum(dim=1), missed.shape[2]
        share = error / error.sum(dim=1, keepdim=True).clamp_min(1e-30)
        chance = (1 - UNIFORM) * share + UNIFORM / count
        edges = torch.multinomial(chance, self.settings.edges, replacement=True)
        weight = 1 / (count * chance.gather(1, edges))
        wanted = missed.take_along_dim(edges[:, None], dim=2).transpose(1, 2)
        return ((self.perceptron(self._features(y, edges)) - wanted).square().mean(dim=2) * weight).mean()


def _waves(surface: Tensor) -> Tensor:
    """(E, w) products of waves of the surface's angles (E, d), up to `ORDER` in each."""
    result = torch.ones_like(surface[:, :1])
    for angle in surface.T:
        multiples = angle[:, None] * torch.arange(1, ORDER + 1)
        waves = torch.cat([torch.ones_like(angle[:, None]), torch.cos(multiples), torch.sin(multiples)], dim=1)
        result = (result[:, :, None] * waves[:, None]).flatten(1)
    return result


def _reading(samples: JointSamples, motion: Motion, j: int, index: list[int], waves: Tensor) -> tuple[Tensor, Tensor]:
    """What latents of factor j are read from, (n, 2 w), and what is read, (n, 2 m_j).

    These are sums of the factor's shape over edges, weighted by waves: a map of all its entries would know a feature
    only where it is in some sample. And cosines and sines of the latents.
    """
    angles = motion.codes[:, index]
    y = samples.scaling.down(samples.factors[: len(angles), j])
    return (y.unflatten(1, (2, -1)) @ waves).flatten(1), torch.stack(
        [torch.cos(angles), torch.sin(angles)], dim=2
    ).flatten(1)
