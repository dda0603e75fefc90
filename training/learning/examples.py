"""What a model misses of its own training shapes, given back where a code is theirs.

Modes leave something out of every shape, and networks add an error. Both are known at the codes of the training
shapes, so that there they can be added: corrections by examples, as in pose space deformation (Lewis, Cordner and
Fong 2000), of lengths and angles.
"""

from __future__ import annotations

import torch
from torch import Tensor

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import unwrap
from shapespace.training.learning.combiners.combiner import CombinerNetwork
from shapespace.training.learning.composite import Composite
from shapespace.training.learning.layers import in_bytes
from shapespace.training.learning.linear import principal_axes
from shapespace.training.learning.networks import predict

#: Most examples, those of which most is missed, and most coordinates in which shapes are told apart.
MOST, COORDINATES = 512, 64
#: Standard deviation of an example's Gaussian, as a share of the distance to the nearest other one: there it has fallen
#: to 0.4 %. Where it is larger, random codes differ from exponentials more (docs/measurements/notes.md, Examples).
WIDTH = 0.3
#: Examples that are nearer to each other than this share of the largest distance are not told apart; and combinations
#: of examples that their Gaussians tell apart less than this, where one is for a single example.
SAME, TOLD_APART = 1e-3, 0.3


class ExampleCorrectedCombiner(CombinerNetwork):
    """A combiner Ψ that also knows what it misses of examples: ``Ψ(x) + Σ_i φ_i(x) r_i``.

    The φ_i are sums of Gaussians around the examples, with ``φ_i = δ_ik`` at example k. They depend, as Ψ does, on
    nothing but the factors' shapes x, by principal coordinates of the sum of these.

    Attributes:
        axes: (2E, d) of the coordinates, integers of 8 bits.
        steps: (1, d) factors of the axes.
        places: (n, d) of the examples.
        sharpness: (n,) ``1 / (2 σ_i²)``.
        weights: (n, 2E) of the Gaussians, in scaled differences; integers of 8 bits.
        units: (n, 1) factors of the weights.
    """

    axes: Tensor
    steps: Tensor
    places: Tensor
    sharpness: Tensor
    weights: Tensor
    units: Tensor

    def __init__(self, combiner: CombinerNetwork, factors: Tensor, missed: Tensor) -> None:
        """Remember.

        Args:
            combiner: Ψ.
            factors: (n, J, 2E) the factors' shapes of n examples.
            missed: (n, 2E) NRIC of these less what Ψ makes of them.
        """
        super().__init__(combiner.scaling, combiner.settings, combiner.correction, combiner.tried)
        scaling, missed = self.scaling, missed * self.scaling.factor
        largest = missed.square().sum(dim=1).argsort(descending=True, stable=True)[:MOST]
        sums, missed = scaling.down(factors[largest]).sum(dim=1), missed[largest]
        _, axes = principal_axes(sums - sums.mean(dim=0), by="rows")
        whole, steps = in_bytes(axes[:COORDINATES].T, dim=0)
        self.register_buffer("axes", whole)
        self.register_buffer("steps", steps)
        places = self._coordinates(factors[largest])
        apart = torch.cdist(places, places)
        widest = float(apart.max())
        apart = torch.where(apart > SAME * widest, apart, widest).amin(dim=1)
        self.register_buffer("places", places)
        self.register_buffer("sharpness", 0.5 / (WIDTH * apart.clamp_min(1e-15)).square())
        gaussians = self._gaussians(places).double()
        # Of shapes that are hardly apart the mean is remembered: their difference would take large weights.
        solved = torch.linalg.pinv(gaussians, atol=TOLD_APART, rtol=0) @ missed.double()
        weights, units = in_bytes(solved.float(), dim=1)
        self.register_buffer("weights", weights)
        self.register_buffer("units", units)

    @classmethod
    def of(cls, composite: Composite, codes: FloatArray, shapes: FloatArray) -> ExampleCorrectedCombiner:
        """The combiner of a composite, with what this misses of shapes with codes (n, m) and NRIC (n, 2E)."""
        factors = predict(composite.factor_shapes, torch.as_tensor(codes, dtype=torch.float32))
        found = predict(composite.combiner, factors)
        exact = unwrap(shapes, found.numpy())
        return cls(composite.combiner, factors, torch.as_tensor(exact, dtype=torch.float32) - found)

    def _coordinates(self, factors: Tensor) -> Tensor:
        """(k, d) of factor shapes (k, J, 2E)."""
        return (self.scaling.down(factors).sum(dim=1) @ self.axes) * self.steps

    def _gaussians(self, places: Tensor) -> Tensor:
        """(k, n) of the examples at coordinates (k, d)."""
        squares = (places[:, None] - self.places).square().sum(dim=2)
        return torch.exp(-self.sharpness * squares)

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Scaled differences (n, 2E) of the joint shape for factor shapes (n, J, 2E)."""
        near = self._gaussians(self._coordinates(inputs)) * self.units.T
        return super().coefficients(inputs) + near @ self.weights
