"""Uncertainty of a fit: the posterior of its code, and the factors of which the scan says little."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.bundle.schema import FactorEntry
from shapespace.model.decoder import Decoder
from shapespace.model.fit_result import FitState
from shapespace.model.fit_search import FitSearch
from shapespace.model.fit_settings import SETTINGS
from shapespace.model.posterior import Posterior
from shapespace.solve.cholesky import NotPositiveDefiniteError

#: A factor is named if its share of the uncertainty is at least this multiple of the largest; at most this number.
COMPARABLE, NAMED = 0.5, 3


def posterior_of(search: FitSearch, state: FitState, shown: NDArray[np.bool_] | None = None) -> Posterior:
    """Return the posterior of a fit's code, as if the scan told nothing of coordinates that are not ``shown`` (m,)."""
    prior, fixed = search.constraints.prior, ~search.constraints.movable
    try:
        return Posterior.of(search.normal(state, shown), prior, fixed)
    except (NotPositiveDefiniteError, ValueError):  # ValueError includes LinAlgError
        # Without derivatives only the prior is known.
        return Posterior.of(np.zeros_like(prior.covariance), prior, fixed)


@dataclass(frozen=True)
class Doubt:
    """Uncertainty of a fit's surface.

    The covariance of a code holds near the fit only, and what the scan hides may be in quite another place. So a
    coordinate counts as unknown if most of its motion is away from the scan.
    """

    away: float  # mean standard deviation of the surface, as a fraction of the diagonal
    causes: list[FactorEntry]  # factors that cause most of it, the main one first

    @classmethod
    def about(cls, search: FitSearch, state: FitState, decoder: Decoder) -> Doubt | None:
        """Return the doubt about a fit, or None if its surface is certain."""
        movable = search.constraints.movable
        try:
            fields = search.derivatives_at(state)
        except NotPositiveDefiniteError:
            return None
        near, areas = search.at_scan(state)
        moved = (fields**2).sum(axis=1)
        squares = np.zeros(len(movable))
        squares[movable] = areas @ moved
        shown = np.ones(len(movable), bool)
        shown[movable] = (areas * near) @ moved >= SETTINGS.shown * squares[movable]
        posterior = posterior_of(search, state, shown)
        spread = np.sqrt(((fields @ posterior.root[movable]) ** 2).sum(axis=(1, 2)))
        away = float(areas @ spread / areas.sum() / decoder.reference.diagonal)
        if away <= SETTINGS.certain:
            return None
        return cls(away, _causes(squares * posterior.covariance.diagonal(), decoder.manifest.factors))

    def tested(
        self, middle: FitSearch, full: FitSearch, state: FitState, decoder: Decoder
    ) -> tuple[FitState, Doubt | None]:
        """Return the better of a fit and of one that begins with the causes at the prior's mean, and the doubt left."""
        code, constraints = state.code.copy(), full.constraints
        for factor in self.causes:
            code[factor.start : factor.stop] = constraints.prior.mean[factor.start : factor.stop]
        begun = middle.start(np.where(constraints.movable, code, state.code), state.placement, state.shape)
        if begun is None:
            return state, self
        found = middle.run(begun, SETTINGS.middle_steps, first=True)
        found = full.run(found, SETTINGS.last_steps, first=False)
        return (found, Doubt.about(full, found, decoder)) if found.cost < state.cost else (state, self)

    @property
    def words(self) -> str:
        """What is doubtful and what to do."""
        *most, last = (factor.name for factor in self.causes)
        names = f"{', '.join(most)} and {last}" if most else last
        return (
            f"the scan says little about {names}: another shape, {self.away:.1%} of the diagonal away on average, may "
            "fit as well. Scan the other sides too, or give landmarks or fixed coordinates."
        )


def _causes(variances: FloatArray, factors: list[FactorEntry]) -> list[FactorEntry]:
    """Return the factors whose coordinates have the largest variances (m,), the largest first."""
    deviations = np.sqrt([variances[factor.start : factor.stop].sum() for factor in factors])
    most = np.argsort(-deviations)[:NAMED]
    return [factors[k] for k in most if deviations[k] >= COMPARABLE * deviations.max()]
