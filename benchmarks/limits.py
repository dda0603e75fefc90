"""Accuracy of a model outside its training bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.training.learning.composite import affine_sum
from shapespace.training.learning.evaluation import r_squared
from shapespace.training.learning.learner import Learner
from shapespace.training.learning.networks import predict
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.workers import run

#: Factors by which the hypercube is enlarged; number of codes in each.
REACHES = (1.0, 1.25, 1.5)
CODES = 100
SEED = 7


def extrapolation(learner: Learner) -> list[dict[str, Any]]:
    """Measure R² on uniform codes in the hypercube stretched about its centre; codes inside the bounds are included.

    Returns:
        For each of ``REACHES`` the number of failed exponentials out of ``CODES``, and R² on the others: composite,
        one-factor network and affine sum of exact factors.
    """
    collection = learner.collection
    coordinates, factors = collection.coordinates, list(collection.factors.values())
    norm = WeightedNorm.of(collection.reference, learner.config.evaluation.eta)
    z_reference = nric(collection.reference.vertices, collection.reference.connectivity)
    middle, half = (coordinates.upper + coordinates.lower) / 2, (coordinates.upper - coordinates.lower) / 2
    unit = np.random.default_rng(SEED).uniform(-1, 1, (CODES, len(coordinates)))
    rows = []
    for reach in REACHES:
        codes = middle + reach * half * unit
        every = [codes, *(alone(codes, index) for index in factors)]
        parts = [part for kind in every for part in np.split(kind, len(kind) // 10)]
        done = dict(run(collection.shapes, parts))
        found = [done[k] for k in range(len(parts))]
        z = np.concatenate([shapes.nric for shapes in found]).reshape(len(every), CODES, -1)
        there = np.array([not reason for shapes in found for reason in shapes.reasons]).reshape(len(every), CODES)
        kept = there.all(axis=0)
        latents = torch.as_tensor(codes[kept], dtype=torch.float32)
        answers = {
            "composite": predict(learner.main(), latents).numpy(),
            "monolithic": predict(learner.monolithic(), latents).numpy(),
            "affine": affine_sum(z_reference, np.swapaxes(z[1:, kept], 0, 1)),
        }
        r2 = {name: r_squared(answer, z[0, kept], norm)["total"] for name, answer in answers.items()}
        rows.append({"reach": reach, "failed": int((~there[0]).sum()), "compared": int(kept.sum()), "r2": r2})
    return rows
