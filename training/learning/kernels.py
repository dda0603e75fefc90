"""Kernel ridge regression on the factors' shapes, another one for each patch of edges, that corrects the affine sum."""

from __future__ import annotations

import torch
from torch import Tensor

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.corrections import JointSamples, Pairs, Slopes
from shapespace.training.learning.gaussian import Centres
from shapespace.training.learning.layers import half_precision
from shapespace.training.learning.linear import Ridge, rounded
from shapespace.training.learning.patches import (
    Patch,
    PatchCorrection,
    common_tensors,
    in_bytes,
    output_rank,
    padded_bases,
    patches_of,
    resized,
)
from shapespace.training.runs.config import KernelSettings
from shapespace.training.runs.progress import progress

#: Candidates for γ, and for the penalty, where the kernel's largest value is 1. With smaller penalties the weights are
#: too large for single precision.
GAMMAS = (0.5, 2.0, 8.0, 32.0)
PENALTIES = tuple(10.0**k for k in range(-6, 0))
#: Most functions that γ is chosen with.
SOME = 800
#: Share of the coordinates' mean square that is left out.
NEGLIGIBLE = 1e-6


class KernelCorrection(PatchCorrection):
    """Kernel ridge regression on the factors' shapes, patch by patch.

    The kernel of two samples is ``exp(−γ |u − u'|²)``, u their coordinates in the metric of the patch. Products of two
    or three coefficients, which describe how factors act on each other, are among the functions that such a kernel
    approximates. Where there are derivatives its gradients are used too (`Centres`).

    With n anchors and k nodes, and rank q of the output:

    Attributes:
        anchors: (P, n, r) coordinates of samples.
        nodes: (P, k, r) of samples with derivatives.
        gammas: (P,).
        weights: (P, q, n + k r), integers of 16 bits.
        steps: (P, n + k r) factors of the functions.
        gains: (P, q) factors of the weights and of the basis.
        basis: (P, S, q), integers of 8 bits.
    """

    anchors: Tensor
    nodes: Tensor
    gammas: Tensor
    weights: Tensor
    steps: Tensor
    gains: Tensor
    basis: Tensor
    #: Fewest edges of a patch, on average.
    EDGES = 24
    #: Most functions of a patch: the time grows with their cube, the size of the network with their number.
    FUNCTIONS = 3000
    #: Largest rank of the output.
    RANK = 176

    @classmethod
    def fit(
        cls, settings: KernelSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> KernelCorrection:
        """See `Correction`; the held-out samples choose metrics too, and the seed is that of the patches."""
        pairs, others = own.pairs, held_out.pairs
        count = max(1, min(settings.patches, len(reference.edges) // cls.EDGES))
        patches = patches_of(_Patch, reference, count, settings.coefficients, pairs, others, seed)
        coordinates = max(patch.rank for patch in patches)
        for patch in progress(patches, "kernels", "patch"):
            patch.fit(pairs, others, own.slopes, coordinates, cls.FUNCTIONS, cls.RANK)
        rank = min(output_rank(patches), cls.RANK)
        bases, outer = in_bytes(padded_bases(patches, rank), dim=1)
        inner = torch.stack([resized(patch.gains, rank) for patch in patches])
        return cls(
            common_tensors(patches, coordinates, pairs[1].shape[1])
            | {
                "anchors": torch.stack([patch.centres.anchors for patch in patches]).float(),
                "nodes": torch.stack([patch.centres.nodes for patch in patches]).float(),
                "gammas": torch.stack([patch.centres.gamma for patch in patches]).float(),
                "weights": torch.stack([resized(patch.weights, rank) for patch in patches]).mT.float().contiguous(),
                "steps": torch.stack([patch.steps for patch in patches]).float(),
                "gains": (inner * outer.squeeze(1)).float(),
                "basis": bases,
            }
        )

    def difference(self, y: Tensor) -> Tensor:
        # Weights are large and of both signs: sums of single precision would be rounding errors in part.
        gammas = self.gammas.double()[:, None, None]
        found = Centres(self.anchors.double(), self.nodes.double(), gammas)(self.coordinates(y).double().mT)
        put_out = self.weights.double() @ (found * self.steps[:, None].double()).mT
        return self.whole(self.basis @ (put_out * self.gains[:, :, None]).to(y.dtype))


class _Patch(Patch):
    """One patch while it is fitted.

    Attributes:
        centres: the functions, in coordinates of 16 bits.
        weights: (n + k r, q) of the coefficients along the axes, integers of 16 bits.
        steps: (n + k r,) factors of the functions.
        gains: (q,) of the coefficients.
    """

    centres: Centres
    weights: Tensor
    steps: Tensor
    gains: Tensor

    @property
    def rank(self) -> int:
        """How many coordinates matter."""
        left = self.spread.sum() - self.spread.cumsum(0)
        return 1 + int((left > NEGLIGIBLE * self.spread.sum()).sum())

    def fit(self, own: Pairs, held_out: Pairs, slopes: Slopes | None, rank: int, most: int, outputs: int) -> None:
        """Ridge regression on ``rank`` coordinates by at most so many functions, of so many outputs.

        Held-out samples choose γ and the penalty.
        """
        x, other = (self.coordinates(inputs, rank) for inputs, _ in (own, held_out))
        wanted, theirs = (residual[:, self.columns].double() - self.mean for _, residual in (own, held_out))
        anchors, nodes = half_precision(x[:most]), x[:0]
        if slopes:
            nodes = half_precision(self.coordinates(slopes.inputs, rank)[: (most - len(anchors)) // rank])
        known = self.slopes(slopes, rank) if slopes else None
        share = min(1.0, SOME / (len(anchors) + nodes.numel()))
        tried = [Centres(anchors, nodes, torch.tensor(gamma, dtype=x.dtype)) for gamma in GAMMAS]

        def fitted(centres: Centres) -> Ridge:
            return centres.fit((x, wanted), known, (other, theirs), PENALTIES)

        self.centres = min(tried, key=lambda centres: fitted(centres.some(share)).error)
        found = fitted(self.centres)
        self.error = found.error * theirs.shape[1]
        features = self.centres(x)
        self.keep_axes(features @ found.weights)
        if known:
            features = torch.cat([features, self.centres.along(*known[:2])])
        weights, steps, gains = rounded(found.weights @ self.basis[:, :outputs].double(), features)
        self.weights, self.steps, self.gains = weights, steps.flatten(), gains.flatten()
