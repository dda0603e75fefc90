"""Kernel ridge regression on factor shapes, separate for each patch of edges, that corrects the affine sum."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.correction import Correction, JointSamples
from shapespace.training.learning.combiners.patches import Patch
from shapespace.training.learning.gaussian import Centres
from shapespace.training.learning.layers import in_bytes, patch_entries, resized
from shapespace.training.runs.network_settings import KernelSettings
from shapespace.training.runs.progress import progress


@dataclass(frozen=True)
class KernelLimits:
    """Limits of the kernel regression."""

    edges: int = 24  # fewest edges of a patch, on average
    # Numbers of functions of a patch, tried in turn while more functions gain a visible accuracy. Learning takes a time
    # that grows with the cube of the number; the time of a shape grows with the number.
    functions: tuple[int, ...] = (750, 1500, 3000)
    rank: int = 176  # largest rank of the output
    slack: float = 0.125  # share by which limiting the rank may increase the squared error on held-out samples
    # Invisible mean squared error, as a share of the shapes' mean square. Smaller gains are left out, since they cost
    # time at every shape.
    unseen: float = 2e-5


LIMITS = KernelLimits()


class KernelCorrection(Correction):
    """Kernel ridge regression on the factor shapes, patch by patch.

    The kernel of two samples is ``exp(−γ |u − u'|²)``, u their coordinates in the metric of the `Patch`. Products of
    two or three coefficients describe how factors interact; such a kernel approximates them. If there are derivatives,
    gradients of the kernel are used too (`Centres`).

    There are P patches of at most S entries of NRIC, with rank r of the metric and q of the output, n anchors and k
    nodes.
    """

    entries: Tensor  # (P, S) indices of the entries in each patch, padded with 2E
    place: Tensor  # (2E,) index of each entry of NRIC in the flat ``entries``
    axes: Tensor  # (P, J, d, S) principal axes of the factor shapes, integers of 8 bits
    units: Tensor  # (P, J d) factors of the axes
    centre: Tensor  # (P, J d) coefficients of the mean shapes
    metric: Tensor  # (P, r, J d) maps coefficients c to coordinates u, ``u = A c``
    mean: Tensor  # (2E,) the constant
    anchors: Tensor  # (P, n, r) coordinates of samples
    nodes: Tensor  # (P, k, r) coordinates of samples with derivatives
    gammas: Tensor  # (P,) γ of each patch
    weights: Tensor  # (P, q, n + k r) weights of the functions, integers of 16 bits
    steps: Tensor  # (P, n + k r) factors of the functions
    gains: Tensor  # (P, q) factors of the weights and of the basis
    basis: Tensor  # (P, S, q) basis of the output, integers of 8 bits

    @classmethod
    def fit(
        cls, settings: KernelSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> KernelCorrection:
        """Fit to samples; see `Correction`. Held-out samples also choose metrics. The seed is used for the patches."""
        pairs, others = own.pairs, held_out.pairs
        count = max(1, min(settings.patches, len(reference.edges) // LIMITS.edges))
        entries = patch_entries(reference.edge_midpoints, count, seed)
        patches = [Patch(columns, settings.coefficients, pairs[0]) for columns in entries]
        for patch in progress(patches, "comparing how factors join, by parts of the surface", "part", len(patches)):
            patch.learn_metric(pairs, others)
        coordinates = max(patch.rank for patch in patches)
        known = len(pairs[0]) + (coordinates * len(own.slopes.inputs) if own.slopes else 0)
        best: list[Patch] = []
        sizes = sorted({min(most, known) for most in LIMITS.functions})
        for k, most in enumerate(sizes, 1):
            fitted = [copy(patch) for patch in patches]
            title = "learning how factors join" + (f", {k} of at most {len(sizes)}" if sizes[1:] else "")
            for patch in progress(fitted, title, "part", len(fitted)):
                patch.fit(pairs, others, own.slopes, coordinates, most, LIMITS.rank)
            if best and _error(best) - _error(fitted) < LIMITS.unseen:
                break
            best = fitted
        return cls(_joined(best, coordinates, min(_output_rank(best), LIMITS.rank)))

    def coordinates(self, y: Tensor) -> Tensor:
        """Return coordinates u (P, n, r) of factor shapes (n, J, 2E)."""
        # With samples as the last dimension, gathers copy rows, and small matrices are multiplied in few operations.
        rows = torch.cat([y, torch.zeros_like(y[:, :, :1])], dim=2).permute(2, 1, 0)
        local = rows.index_select(0, self.entries.flatten()).unflatten(0, self.entries.shape).transpose(1, 2)
        c = (self.axes @ local).flatten(1, 2).mT * self.units[:, None] - self.centre[:, None]
        return c @ self.metric.mT

    def difference(self, y: Tensor) -> Tensor:
        # Weights are large and have both signs, so sums in single precision would partly be rounding errors.
        gammas = self.gammas.double()[:, None, None]
        found = Centres(self.anchors.double(), self.nodes.double(), gammas)(self.coordinates(y).double())
        # Scale after transposing: onnxruntime would fuse the reverse, and old versions can't run that for doubles.
        put_out = self.weights.double() @ (found.mT * self.steps[:, :, None].double())
        # From here on a code is a row, which takes a fraction of the time of a column for a single code.
        parts = (put_out.mT * self.gains[:, None]).to(y.dtype) @ self.basis.mT
        return parts.transpose(0, 1).flatten(1).index_select(1, self.place) + self.mean


def _joined(patches: Sequence[Patch], coordinates: int, rank: int) -> dict[str, Tensor]:
    """Return the tensors of a `KernelCorrection` with given numbers of coordinates and of outputs of each patch."""
    # Shorter patches are padded with an entry after the last entry of NRIC, where shapes are zero.
    size = sum(len(patch.columns) for patch in patches)
    entries = _padded([torch.as_tensor(patch.columns) for patch in patches], size)
    mean = torch.zeros(size)
    for patch in patches:
        mean[patch.columns] = patch.mean.float()
    basis, outer = in_bytes(_padded([resized(patch.basis, rank) for patch in patches]), dim=1)
    inner = torch.stack([resized(patch.gains, rank) for patch in patches])
    return {
        "entries": entries,
        "place": torch.argsort(entries.flatten())[:size],
        "axes": _padded([patch.axes.permute(2, 0, 1) for patch in patches]).permute(0, 2, 3, 1).contiguous(),
        "units": torch.stack([patch.units for patch in patches]).float(),
        "centre": torch.stack([patch.centre for patch in patches]).float(),
        "metric": torch.stack([patch.metric[:coordinates] for patch in patches]),
        "mean": mean,
        "anchors": torch.stack([patch.centres.anchors for patch in patches]).float(),
        "nodes": torch.stack([patch.centres.nodes for patch in patches]).float(),
        "gammas": torch.stack([patch.centres.gamma for patch in patches]).float(),
        "weights": torch.stack([resized(patch.weights, rank) for patch in patches]).mT.float().contiguous(),
        "steps": torch.stack([patch.steps for patch in patches]).float(),
        "gains": (inner * outer.squeeze(1)).float(),
        "basis": basis,
    }


def _padded(parts: Sequence[Tensor], value: float = 0) -> Tensor:
    return nn.utils.rnn.pad_sequence(list(parts), batch_first=True, padding_value=value)


def _error(patches: Sequence[Patch]) -> float:
    """Return the mean squared error on held-out samples, as a share of the shapes' mean square."""
    # Scaled differences have a mean square of one over all entries.
    return sum(patch.error for patch in patches) / sum(len(patch.columns) for patch in patches)


def _output_rank(patches: Sequence[Patch]) -> int:
    """Return the smallest rank of the output that adds no more to the squared error than `KernelLimits` allows."""
    energy = _padded([patch.energy for patch in patches]).sum(dim=0) / sum(len(patch.columns) for patch in patches)
    lost = energy.sum() - energy.cumsum(0)
    return min(int((lost > max(LIMITS.slack * _error(patches), LIMITS.unseen)).sum()) + 1, len(energy))
