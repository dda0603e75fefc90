"""The start network: latents to vertices, roughly and at no cost, for codes at which frames go astray."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align
from shapespace.training.learning.corrections import low_rank, ridge_regression
from shapespace.training.learning.layers import LatentFeatures, Polynomials
from shapespace.training.learning.learning import Learner
from shapespace.training.runs.coordinates import Coordinates

DEGREE, RANK = 2, 32


class StartNetwork(nn.Module):
    """Codes (n, m) → vertices (n, V, 3): polynomials of the latents, and a linear map of low rank.

    Of a periodic coordinate the cosine and the sine are taken. Positions turn with every bend between them and the
    middle, so that no polynomial of low degree is close (a figure: 0.8 % of the diagonal at degree 2, 0.7 % at
    degree 3, where frames leave 0.1 %): it is there for its robustness, and for that degree 2 is enough.
    """

    reference: Tensor
    weights: Tensor
    basis: Tensor

    def __init__(self, coordinates: Coordinates, reference: FloatArray) -> None:
        super().__init__()
        self.features = LatentFeatures(coordinates, order=1)
        size = self.features.size
        box = Coordinates(np.full(size, -1.0), np.ones(size), np.full(size, np.nan))
        self.polynomials = Polynomials(box, DEGREE)
        rank = min(self.polynomials.size, RANK)
        self.register_buffer("reference", torch.tensor(reference, dtype=torch.float32))
        self.register_buffer("weights", torch.zeros(self.polynomials.size, rank))
        self.register_buffer("basis", torch.zeros(rank, reference.size))

    def fit(self, latents: Tensor, vertices: NDArray, held_out: tuple[Tensor, NDArray]) -> None:
        """Fit to codes (n, m) and their shapes (n, V, 3) by ridge regression; pairs held out choose its penalty."""
        reference = self.reference.double().numpy()

        def pair(latents: Tensor, vertices: NDArray) -> tuple[Tensor, Tensor]:
            offsets = align(np.asarray(vertices, dtype=np.float64), reference) - reference
            return self.polynomials(self.features(latents)), torch.as_tensor(offsets).flatten(1)

        h, b = ridge_regression(*pair(latents, vertices), pair(*held_out))
        weights, basis = low_rank(h, b, len(self.basis))
        self.weights.copy_(weights)
        self.basis.copy_(basis)

    def forward(self, latent: Tensor) -> Tensor:  # noqa: D102 - see the class
        offsets = self.polynomials(self.features(latent)) @ self.weights @ self.basis
        return self.reference + offsets.unflatten(1, self.reference.shape)


def fit_start(learner: Learner) -> StartNetwork:
    """The start network of a run, from its joint samples; in closed form, in seconds."""
    collection, samples, rows = learner.collection, learner.joint, learner.rows
    network = StartNetwork(collection.coordinates, collection.reference.vertices)
    latents = torch.as_tensor(samples.latents, dtype=torch.float32)
    train, held_out = rows["train"], rows["validation"]
    network.fit(latents[train], samples.vertices[train], (latents[held_out], samples.vertices[held_out]))
    return network
