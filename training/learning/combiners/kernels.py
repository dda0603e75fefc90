"""Kernel ridge regression on the factors' shapes, another one for each patch of edges, that corrects the affine sum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, Self

import torch
from torch import Tensor, nn

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.correction import Correction, JointSamples
from shapespace.training.learning.combiners.patches import Patch
from shapespace.training.learning.gaussian import Centres
from shapespace.training.learning.layers import in_bytes, patch_entries, resized
from shapespace.training.runs.config import KernelSettings
from shapespace.training.runs.progress import progress

#: By which share the rank of the output may increase the squared error on held-out samples.
SLACK = 0.125
#: A mean squared error that nobody sees, as a share of the shapes' mean square. What gains less is left out, since it
#: costs time at every shape.
UNSEEN = 2e-5


class KernelCorrection(Correction):
    """Kernel ridge regression on the factors' shapes, patch by patch.

    The kernel of two samples is ``exp(−γ |u − u'|²)``, u their coordinates in the metric of the `Patch`. Products of
    two or three coefficients, which describe how factors act on each other, are among the functions that such a kernel
    approximates. Where there are derivatives its gradients are used too (`Centres`).

    With P patches of at most S entries of NRIC, rank r of the metric and q of the output, n anchors and k nodes:

    Attributes:
        entries: (P, S) indices of the entries in each patch, 2E where there are fewer.
        place: (2E,) index in the flat ``entries`` of each entry of NRIC.
        axes: (P, J, d, S) principal axes of the factors' shapes, integers of 8 bits.
        units: (P, J d) factors of the axes.
        centre: (P, J d) coefficients of the mean shapes.
        metric: (P, r, J d) coordinates u of coefficients c, ``u = A c``.
        mean: (2E,) the constant.
        anchors: (P, n, r) coordinates of samples.
        nodes: (P, k, r) of samples with derivatives.
        gammas: (P,).
        weights: (P, q, n + k r), integers of 16 bits.
        steps: (P, n + k r) factors of the functions.
        gains: (P, q) factors of the weights and of the basis.
        basis: (P, S, q), integers of 8 bits.
    """

    entries: Tensor
    place: Tensor
    axes: Tensor
    units: Tensor
    centre: Tensor
    metric: Tensor
    mean: Tensor
    anchors: Tensor
    nodes: Tensor
    gammas: Tensor
    weights: Tensor
    steps: Tensor
    gains: Tensor
    basis: Tensor
    #: Fewest edges of a patch, on average.
    EDGES = 24
    #: How many functions of a patch are tried, in turn, as long as more of them gain what can be seen: learning takes a
    #: time that grows with their cube, and what a shape costs grows with their number.
    FUNCTIONS = (750, 1500, 3000)
    #: Largest rank of the output.
    RANK = 176

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)

    @classmethod
    def load(cls, settings: Any, reference: TriangleMesh, tensors: Mapping[str, Tensor]) -> Self:
        """See `Correction`."""
        return cls(tensors)

    @classmethod
    def fit(
        cls, settings: KernelSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> KernelCorrection:
        """See `Correction`; the held-out samples choose metrics too, and the seed is that of the patches."""
        pairs, others = own.pairs, held_out.pairs
        count = max(1, min(settings.patches, len(reference.edges) // cls.EDGES))
        entries = patch_entries(reference.edge_midpoints, count, seed)
        patches = [Patch(columns, settings.coefficients, pairs[0]) for columns in entries]
        for patch in progress(patches, "metrics", "patch"):
            patch.learn_metric(pairs, others)
        coordinates = max(patch.rank for patch in patches)
        known = len(pairs[0]) + (coordinates * len(own.slopes.inputs) if own.slopes else 0)
        best: list[Patch] = []
        for most in sorted({min(most, known) for most in cls.FUNCTIONS}):
            fitted = [copy(patch) for patch in patches]
            for patch in progress(fitted, f"kernels, {most} functions", "patch"):
                patch.fit(pairs, others, own.slopes, coordinates, most, cls.RANK)
            if best and _error(best) - _error(fitted) < UNSEEN:
                break
            best = fitted
        return cls(_joined(best, coordinates, min(_output_rank(best), cls.RANK)))

    def coordinates(self, y: Tensor) -> Tensor:
        """(P, n, r) coordinates u of factor shapes (n, J, 2E)."""
        # The dimension of samples comes last: so gathers copy rows, and products of small matrices are few operations.
        rows = torch.cat([y, torch.zeros_like(y[:, :, :1])], dim=2).permute(2, 1, 0)
        local = rows.index_select(0, self.entries.flatten()).unflatten(0, self.entries.shape).transpose(1, 2)
        c = (self.axes @ local).flatten(1, 2).mT * self.units[:, None] - self.centre[:, None]
        return c @ self.metric.mT

    def difference(self, y: Tensor) -> Tensor:
        # Weights are large and of both signs: sums of single precision would be rounding errors in part.
        gammas = self.gammas.double()[:, None, None]
        found = Centres(self.anchors.double(), self.nodes.double(), gammas)(self.coordinates(y).double())
        # Scaled once transposed, so that onnxruntime fuses nothing here: old ones can't run that for doubles.
        put_out = self.weights.double() @ (found.mT * self.steps[:, :, None].double())
        # From here on a code is a row: for one alone that takes a fraction of the time that a column does.
        parts = (put_out.mT * self.gains[:, None]).to(y.dtype) @ self.basis.mT
        return parts.transpose(0, 1).flatten(1).index_select(1, self.place) + self.mean


def _joined(patches: Sequence[Patch], coordinates: int, rank: int) -> dict[str, Tensor]:
    """The tensors of a `KernelCorrection`, with so many coordinates and outputs of each patch."""
    # Shorter patches are padded with an entry of NRIC that does not exist, where shapes are zero.
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
    """(P, longest, …) of P tensors (·, …)."""
    return nn.utils.rnn.pad_sequence(list(parts), batch_first=True, padding_value=value)


def _error(patches: Sequence[Patch]) -> float:
    """Mean squared error on held-out samples, as a share of the shapes' mean square."""
    # Scaled differences have a mean square of one over all entries.
    return sum(patch.error for patch in patches) / sum(len(patch.columns) for patch in patches)


def _output_rank(patches: Sequence[Patch]) -> int:
    """The smallest rank of the output that adds no more to the squared error than SLACK and UNSEEN say."""
    energy = _padded([patch.energy for patch in patches]).sum(dim=0) / sum(len(patch.columns) for patch in patches)
    lost = energy.sum() - energy.cumsum(0)
    return min(int((lost > max(SLACK * _error(patches), UNSEEN)).sum()) + 1, len(energy))
