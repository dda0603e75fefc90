"""Kernel ridge regression on the factors' shapes, another one for each patch of edges, that corrects the affine sum."""

from __future__ import annotations

import torch
from torch import Tensor

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.corrections import JointSamples, Pairs, Slopes
from shapespace.training.learning.layers import half_precision
from shapespace.training.learning.linear import SpectralRidge, kernel_ridge
from shapespace.training.learning.patches import (
    Patch,
    PatchCorrection,
    common_tensors,
    output_rank,
    padded_bases,
    patches_of,
)
from shapespace.training.runs.config import KernelSettings
from shapespace.training.runs.progress import progress

#: Candidates for γ, and for the penalty, where the kernel's largest value is 1. With smaller penalties the weights are
#: too large for single precision.
GAMMAS = (0.5, 2.0, 8.0, 32.0)
PENALTIES = tuple(10.0 ** (k / 2) for k in range(-11, 0))
#: Most samples that γ is chosen with.
SOME = 800
#: Share of the coordinates' mean square that is left out.
NEGLIGIBLE = 1e-6


class KernelCorrection(PatchCorrection):
    """Kernel ridge regression on the factors' shapes, patch by patch.

    The kernel of two samples is ``exp(−γ |u − u'|²)``, u their coordinates in the metric of the patch. Products of two
    or three coefficients, which describe how factors act on each other, are among the functions that such a kernel
    approximates.

    With n samples, and rank k of the output:

    Attributes:
        anchors: (P, n, r) coordinates of the samples.
        gammas: (P,).
        weights: (P, k, n).
        basis: (P, S, k).
    """

    anchors: Tensor
    gammas: Tensor
    weights: Tensor
    basis: Tensor
    #: Fewest edges of a patch, on average.
    EDGES = 24
    #: Most samples to fit to: the time grows with their cube, the size of the network with their number.
    ANCHORS = 4000
    #: Largest rank of the output.
    RANK = 128

    @classmethod
    def fit(
        cls, settings: KernelSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> KernelCorrection:
        """See `Correction`; the held-out samples choose metrics too, and the seed is that of the patches."""
        inputs, missed = own.pairs
        pairs, others = (inputs[: cls.ANCHORS], missed[: cls.ANCHORS]), held_out.pairs
        count = max(1, min(settings.patches, len(reference.edges) // cls.EDGES))
        patches = patches_of(_Patch, reference, count, settings.coefficients, pairs, others, seed)
        coordinates = max(patch.rank for patch in patches)
        for patch in progress(patches, "kernels", "patch"):
            patch.fit(pairs, others, own.slopes, coordinates)
        bases = padded_bases(patches, min(output_rank(patches), cls.RANK))
        return cls(
            common_tensors(patches, coordinates, missed.shape[1])
            | {
                "anchors": torch.stack([patch.anchors for patch in patches]),
                "gammas": torch.tensor([patch.gamma for patch in patches]),
                "weights": torch.stack([patch.weights_in(basis) for patch, basis in zip(patches, bases, strict=True)]),
                "basis": half_precision(bases),
            }
        )

    def difference(self, y: Tensor) -> Tensor:
        # Weights are large and of both signs: sums of single precision would be rounding errors in part.
        u, anchors = self.coordinates(y).double(), self.anchors.double()
        squares = anchors.square().sum(dim=2, keepdim=True) - 2 * anchors @ u + u.square().sum(dim=1, keepdim=True)
        found = torch.exp(-self.gammas.double()[:, None, None] * squares)
        return self.whole(self.basis @ (self.weights.double() @ found).to(y.dtype))


class _Patch(Patch):
    """One patch while it is fitted.

    Attributes:
        anchors: (n, r) coordinates of the samples.
        gamma: γ.
        weights: (n, S), in double precision.
    """

    @property
    def rank(self) -> int:
        """How many coordinates matter."""
        left = self.spread.sum() - self.spread.cumsum(0)
        return 1 + int((left > NEGLIGIBLE * self.spread.sum()).sum())

    def fit(self, own: Pairs, held_out: Pairs, slopes: Slopes | None, rank: int) -> None:
        """Kernel ridge regression on so many coordinates, with γ and the penalty that suit held-out samples."""
        self.anchors = self.coordinates(own[0], rank).float()
        x, other = self.anchors.double(), self.coordinates(held_out[0], rank)
        wanted, theirs = (residual[:, self.columns].double() - self.mean for _, residual in (own, held_out))

        def error(gamma: float) -> float:
            some = x[:SOME]
            chosen_by = _kernel(other, some, gamma), theirs
            return SpectralRidge.fit(_kernel(some, some, gamma), wanted[:SOME], chosen_by, PENALTIES).error

        self.gamma = min(GAMMAS, key=error)
        kernel, rows = _kernel(x, x, self.gamma), None
        if slopes:
            at, along, missed = self.slopes(slopes, rank)
            towards = along @ x.T - (along * at).sum(dim=1, keepdim=True)
            rows = 2 * self.gamma * towards * _kernel(at, x, self.gamma), missed
        found = kernel_ridge(kernel, wanted, rows, (_kernel(other, x, self.gamma), theirs), PENALTIES)
        self.weights, self.error = found.weights, found.error * theirs.shape[1]
        self.keep_axes(kernel @ found.weights)

    def weights_in(self, basis: Tensor) -> Tensor:
        """(k, n) of the coefficients in a basis (at least S, k)."""
        return (self.weights @ basis[: len(self.columns)].double()).T.float()


def _kernel(x: Tensor, anchors: Tensor, gamma: float) -> Tensor:
    """(m, n) of coordinates (m, r) and (n, r)."""
    return torch.exp(-gamma * torch.cdist(x, anchors).square())
