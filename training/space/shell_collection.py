"""A collection parametrised by the tangent space at its mean: codes are velocities, shapes their exponentials."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.exponential_derivative import ExponentialDerivative
from shapespace.shell.space import DiscretePath, FirstStep, ShellSpace
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.sampling import SampledShapes
from shapespace.training.space.codes import LIMIT_STEPS


def names_of(factors: dict[str, list[int]]) -> tuple[str, ...]:
    """Name latents after their factors: "upper left", or "upper left, 1" and so on where a factor has several."""
    names = {}
    for factor, members in factors.items():
        for k, j in enumerate(members, 1):
            names[j] = factor if len(members) == 1 else f"{factor}, {k}"
    return tuple(names[j] for j in sorted(names))


@dataclass(frozen=True, eq=False)
class ShellCollection:
    """The shapes ``exp_z̄(Σ_j w_j u_j)`` of codes w in a hypercube (paper, section 3); see sampling.Collection.

    It is pickled without the symbolic analysis of its space. A process that unpickles it repeats the analysis once, at
    the first shape. The reference is the mean z̄, modes (m, V, 3) are vertex fields d_j there, ``u_j = Dz d_j``, and
    ``lower`` and ``upper`` (m,) are the bounds of the coefficients.
    """

    reference: TriangleMesh
    modes: FloatArray
    lower: FloatArray
    upper: FloatArray
    factors: dict[str, list[int]]
    steps: int
    material: Material
    scale: float
    codes: FloatArray
    with_derivatives: bool = False
    first_step: FirstStep = "centred"
    #: Modes move no feature over the surface, and no symmetry is known.
    places = None
    symmetries = ()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "space"}

    @cached_property
    def space(self) -> ShellSpace:
        """The Riemannian manifold around the mean."""
        return ShellSpace(self.reference, self.material, first_step=self.first_step)

    @property
    def latent_names(self) -> tuple[str, ...]:
        """(m,) names after the factors."""
        return names_of(self.factors)

    @property
    def coordinates(self) -> Coordinates:
        """The hypercube, of coordinates without a period."""
        return Coordinates(self.lower, self.upper, np.full(len(self.modes), np.nan))

    @property
    def limit(self) -> ShellCollection | None:
        """The same collection near the limit of many steps; None for one step, which approximates no geodesic."""
        return replace(self, steps=LIMIT_STEPS, first_step="centred") if self.steps > 1 else None

    @property
    def differentiated(self) -> ShellCollection:
        """The same collection, with derivatives of its shapes."""
        return replace(self, with_derivatives=True)

    def shapes(self, latents: FloatArray) -> SampledShapes:
        """Exponentials of codes (n, m), with one BLAS thread; angles are unwrapped along each geodesic."""
        # One code at a time: a product with all of them would round differently with their number.
        velocities = np.stack([np.tensordot(code, self.modes, axes=1) for code in latents])
        with threadpool_limits(1):
            paths = [exponential(self.space, self.reference.vertices, v, self.steps) for v in velocities]
            reasons = ["" if path.converged else f"{path.status}: {path.reason}" for path in paths]
            derivatives = None
            if self.with_derivatives:
                derivatives = np.zeros((len(paths), len(self.modes), paths[0].nric.shape[1]))
                for k, path in enumerate(paths):
                    if path.converged:
                        try:
                            derivatives[k] = self._derivative(path)
                        except RuntimeError as error:
                            reasons[k] = f"no derivative: {error}"
        vertices, z = (np.stack(ends) for ends in zip(*((p.vertices[-1], p.nric[-1]) for p in paths), strict=True))
        return SampledShapes(vertices, z, reasons, derivatives)

    def _derivative(self, path: DiscretePath) -> FloatArray:
        end = path.space.point(path.vertices[-1])
        return np.stack([end.push_forward(x) for x in ExponentialDerivative(path).push_forward(self.modes)])
