"""Accuracy of the qualities of a model: the distances of drafts and of ``auto`` from full shapes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.bundle.schema import AutoError, DraftError
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.latent_space import Distribution
from shapespace.model.shape import Quality

#: Number of random codes by which errors are measured.
MEASURED_CODES = 50
#: Tolerances of ``auto`` that are tried, as fractions of the diagonal; None takes the draft. The largest is small, so
#: that a rare code with a bad draft gets more steps than were needed in the measurement.
TOLERANCES = (None, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
#: Largest mean distance between ``auto`` and full shapes, as a share of the mean distance between full and exact
#: shapes. By the triangle inequality, ``auto`` is then at most 1.1 times as far from exact shapes on average.
SHARE = 0.1


@dataclass(frozen=True)
class Accuracy:
    """Distances from full shapes, over vertices and random codes inside the bounds."""

    draft_error: DraftError
    auto_error: AutoError | None  # None if ``auto`` has to answer full shapes


def measure_accuracy(decoder: Decoder) -> Accuracy:
    """Measure the distance between drafts and full shapes, and find the largest tolerance for ``auto``.

    The decoder then uses this tolerance. The distance between full and exact shapes is the vertex error that the
    evaluation of the run measured. Without this figure ``auto`` answers full shapes.

    Raises NotFiniteError or ModelFailedError.
    """
    codes = decoder.latents.sample(MEASURED_CODES, 0, Distribution.UNIFORM)
    full = [decoder.shape(code).vertices for code in codes]
    size = decoder.manifest.scale * decoder.mesh(MeshChoice.FINE).diagonal

    def distances(quality: Quality) -> FloatArray:
        found = np.stack([decoder.shape(code, quality=quality).vertices for code in codes])
        return np.linalg.norm(found - full, axis=-1) / size

    drafts = distances(Quality.DRAFT)
    draft_error = DraftError(**_summary(drafts))
    vertex_error: Any = decoder.manifest.figures.get("vertex_error")
    allowed = SHARE * vertex_error["mean"] if isinstance(vertex_error, dict) else 0.0
    for tolerance in TOLERANCES:
        decoder.auto = AutoError(mean=0, p95=0, tolerance=tolerance)
        away = drafts if tolerance is None else distances(Quality.AUTO)
        if away.mean() <= allowed:
            decoder.auto = AutoError(**_summary(away), tolerance=tolerance)
            return Accuracy(draft_error, decoder.auto)
    decoder.auto = None
    return Accuracy(draft_error, None)


def _summary(away: FloatArray) -> dict[str, float]:
    return {"mean": float(away.mean()), "p95": float(np.percentile(away, 95))}
