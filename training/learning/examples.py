"""Correct a combiner at the codes of the training shapes, so that the model reproduces these shapes.

Modes lose a part of every shape, and networks add an error. Both are known at the codes of the training shapes, so
that the combiner can add them there. This is correction by examples, as in pose space deformation (Lewis, Cordner and
Fong 2000), applied to lengths and angles.
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
from shapespace.training.space.memory import GAUSSIANS


class ExampleCorrectedCombiner(CombinerNetwork):
    """Combiner Ψ plus its errors at training shapes (examples): ``Ψ(x) + Σ_i φ_i(x) r_i``.

    The φ_i are sums of Gaussians around the examples, with ``φ_i = δ_ik`` at example k. They depend, as Ψ does, on
    nothing but the factor shapes x, through principal coordinates of their sum.
    """

    axes: Tensor  # (2E, d) axes of the coordinates, integers of 8 bits
    steps: Tensor  # (1, d) factors of the axes
    places: Tensor  # (n, d) coordinates of the examples
    sharpness: Tensor  # (n,) ``1 / (2 σ_i²)``
    weights: Tensor  # (n, 2E) weights of the Gaussians, in scaled differences; integers of 8 bits
    units: Tensor  # (n, 1) factors of the weights

    def __init__(self, combiner: CombinerNetwork, factors: Tensor, missed: Tensor) -> None:
        """Fit the Gaussians to factor shapes (n, J, 2E), and exact NRIC minus the output of Ψ, ``missed`` (n, 2E)."""
        super().__init__(combiner.scaling, combiner.settings, combiner.correction, combiner.tried)
        scaling, missed = self.scaling, missed * self.scaling.factor
        largest = missed.square().sum(dim=1).argsort(descending=True, stable=True)[: GAUSSIANS.examples]
        sums, missed = scaling.down(factors[largest]).sum(dim=1), missed[largest]
        _, axes = principal_axes(sums - sums.mean(dim=0), by="rows")
        whole, steps = in_bytes(axes[: GAUSSIANS.coordinates].T, dim=0)
        self.register_buffer("axes", whole)
        self.register_buffer("steps", steps)
        places = self._coordinates(factors[largest])
        apart = torch.cdist(places, places)
        widest = float(apart.max())
        apart = torch.where(apart > GAUSSIANS.same * widest, apart, widest).amin(dim=1)
        self.register_buffer("places", places)
        self.register_buffer("sharpness", 0.5 / (GAUSSIANS.width * apart.clamp_min(1e-15)).square())
        gaussians = self._gaussians(places).double()
        # Of almost equal shapes the mean is stored, since their difference would take large weights.
        solved = torch.linalg.pinv(gaussians, atol=GAUSSIANS.distinct, rtol=0) @ missed.double()
        weights, units = in_bytes(solved.float(), dim=1)
        self.register_buffer("weights", weights)
        self.register_buffer("units", units)

    @classmethod
    def of(cls, composite: Composite, codes: FloatArray, shapes: FloatArray) -> ExampleCorrectedCombiner:
        """Correct the combiner of a composite by shapes with codes (n, m) and NRIC (n, 2E)."""
        factors = predict(composite.factor_shapes, torch.as_tensor(codes, dtype=torch.float32))
        found = predict(composite.combiner, factors)
        exact = unwrap(shapes, found.numpy())
        return cls(composite.combiner, factors, torch.as_tensor(exact, dtype=torch.float32) - found)

    def _coordinates(self, factors: Tensor) -> Tensor:
        """Return coordinates (k, d) of factor shapes (k, J, 2E)."""
        return (self.scaling.down(factors).sum(dim=1) @ self.axes) * self.steps

    def _gaussians(self, places: Tensor) -> Tensor:
        """Return values (k, n) of the examples' Gaussians at coordinates (k, d)."""
        squares = (places[:, None] - self.places).square().sum(dim=2)
        return torch.exp(-self.sharpness * squares)

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Return scaled differences (n, 2E) of the joint shape for factor shapes (n, J, 2E)."""
        near = self._gaussians(self._coordinates(inputs)) * self.units.T
        return super().coefficients(inputs) + near @ self.weights
