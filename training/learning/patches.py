"""What corrections that differ from patch to patch share: factors' shapes there as coordinates in a learned metric."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self, TypeVar

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.corrections import Correction, Pairs, Slopes
from shapespace.training.learning.layers import half_precision, patch_entries
from shapespace.training.learning.linear import SpectralRidge, principal_axes
from shapespace.training.runs.progress import progress

#: By which share the rank of the output may increase the squared error on held-out samples.
SLACK = 0.125
#: Most samples that the principal axes of factors are computed from.
AXES = 500


class PatchCorrection(Correction):
    """A correction that is another function in each patch of neighbouring edges.

    How factors act on each other at an edge depends on what each of them does nearby. So in each patch the shape of
    every factor is projected to a few principal coefficients. All factors' are more coordinates than the samples can
    tell apart, but only few directions among them matter: they are found first, as a metric (`learned_metric`).

    With P patches of at most S entries of NRIC and rank r of the metric:

    Attributes:
        entries: (P, S) indices of the entries in each patch, 2E where there are fewer.
        place: (2E,) index in the flat ``entries`` of each entry of NRIC.
        axes: (P, J, d, S) principal axes of the factors' shapes, integers of 8 bits.
        units: (P, J d) factors of the axes.
        centre: (P, J d) coefficients of the mean shapes.
        metric: (P, r, J d) coordinates u of coefficients c, ``u = A c``.
        mean: (2E,) the constant.
    """

    entries: Tensor
    place: Tensor
    axes: Tensor
    units: Tensor
    centre: Tensor
    metric: Tensor
    mean: Tensor

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)

    @classmethod
    def load(cls, settings: Any, reference: TriangleMesh, tensors: Mapping[str, Tensor]) -> Self:
        """See `Correction`."""
        return cls(tensors)

    def coordinates(self, y: Tensor) -> Tensor:
        """(P, r, n) coordinates u of factor shapes (n, J, 2E)."""
        # The dimension of samples comes last: so gathers copy rows, and products of small matrices are few operations.
        rows = torch.cat([y, torch.zeros_like(y[:, :, :1])], dim=2).permute(2, 1, 0)
        local = rows.index_select(0, self.entries.flatten()).unflatten(0, self.entries.shape).transpose(1, 2)
        c = (self.axes @ local).flatten(1, 2) * self.units[:, :, None] - self.centre[:, :, None]
        return self.metric @ c

    def whole(self, parts: Tensor) -> Tensor:
        """(n, 2E) of what the patches put out (P, S, n), and the constant."""
        return parts.flatten(0, 1).index_select(0, self.place).T + self.mean


class Patch:
    """One patch while it is fitted.

    Attributes:
        columns: (S,) its entries of NRIC, lengths and then angles.
        axes: (J, d, S) principal axes of the factors' shapes there, integers of 8 bits.
        units: (J d,) factors of the axes, with which the first coefficient of the widest factor has a variance of one.
        centre: (J d,) coefficients of the mean shapes.
        metric: (J d, J d) rows A of the coordinates ``u = A c`` of coefficients c, those of the largest variance first.
        spread: (J d,) mean squares of the coordinates.
        mean: (S,) the constant.
        basis: (S, k) principal axes of what is put out.
        energy: (k,) mean squares along these.
        error: squared error on held-out samples, their mean summed over the entries.
    """

    error: float

    def __init__(self, columns: NDArray, coefficients: int, y: Tensor) -> None:
        self.columns, axes, centre, widest = columns, [], [], 0.0
        for shapes in y[:, :, columns].double().unbind(1):
            middle = shapes.mean(dim=0)
            s, vt = principal_axes(shapes - middle, by="svd")
            vt = nn.functional.pad(vt[:coefficients], (0, 0, 0, max(0, coefficients - len(vt))))
            axes.append(vt)
            centre.append(vt @ middle)
            widest = max(widest, float(s[0]) / len(y) ** 0.5)
        whole, unit = in_bytes(torch.stack(axes), dim=2)
        self.axes = whole.float()
        self.units = unit.flatten() / max(widest, 1e-12)
        self.centre = torch.cat(centre) / max(widest, 1e-12)

    def inputs(self, y: Tensor) -> Tensor:
        """(n, J d) coefficients of factor shapes (n, J, 2E)."""
        c = torch.einsum("njs,jds->njd", y[:, :, self.columns].double(), self.axes.double())
        return c.flatten(1) * self.units - self.centre

    def learn_metric(self, own: Pairs, held_out: Pairs) -> None:
        """Find the metric, and its principal coordinates."""
        x, other = self.inputs(own[0]), self.inputs(held_out[0])
        wanted, theirs = (pairs[1][:, self.columns].double() for pairs in (own, held_out))
        self.mean = wanted.mean(dim=0)
        metric = learned_metric(x, wanted - self.mean, (other, theirs - self.mean))
        # The kernel is invariant under rotations: in the principal axes of the samples the fewest coordinates matter.
        z = x @ metric
        s, axes = principal_axes(z, by="columns")
        self.metric, self.spread = half_precision((metric @ axes.T).T.float()), s.square() / len(z)

    def coordinates(self, y: Tensor, rank: int) -> Tensor:
        """(n, rank) first coordinates of factor shapes (n, J, 2E)."""
        return self.inputs(y) @ self.metric[:rank].double().T

    def slopes(self, slopes: Slopes, rank: int) -> tuple[Tensor, Tensor, Tensor]:
        """Coordinates (k m, rank) where there are derivatives, those of coordinates, and (k m, S) of the residual."""
        axes, metric = self.axes.double().transpose(1, 2), self.metric[:rank].double().T
        along = (slopes.coefficients(axes, self.columns) * self.units) @ metric
        at = slopes.repeated(self.coordinates(slopes.inputs, rank))
        return at, along, slopes.missed[:, :, self.columns].flatten(0, 1).double()

    def keep_axes(self, values: Tensor) -> None:
        """Principal axes of what is put out at the samples (n, S)."""
        s, axes = principal_axes(values, by="columns")
        self.energy, self.basis = s.square() / len(values), axes.T.float()


_Kind = TypeVar("_Kind", bound=Patch)


def patches_of(
    kind: type[_Kind],
    reference: TriangleMesh,
    count: int,
    coefficients: int,
    own: Pairs,
    held_out: Pairs,
    seed: int,
) -> list[_Kind]:
    """So many patches of a kind, with so many principal coefficients of each factor, and their metrics."""
    entries = patch_entries(reference.edge_midpoints, count, seed)
    patches = [kind(columns, coefficients, own[0][:AXES]) for columns in entries]
    for patch in progress(patches, "metrics", "patch"):
        patch.learn_metric(own, held_out)
    return patches


def common_tensors(patches: Sequence[Patch], rank: int, size: int) -> dict[str, Tensor]:
    """The tensors of a `PatchCorrection` of 2E = ``size``."""
    # Shorter patches are padded with an entry of NRIC that does not exist, where shapes are zero.
    entries = _padded([torch.as_tensor(patch.columns) for patch in patches], size)
    mean = torch.zeros(size)
    for patch in patches:
        mean[patch.columns] = patch.mean.float()
    return {
        "entries": entries,
        "place": torch.argsort(entries.flatten())[:size],
        "axes": _padded([patch.axes.permute(2, 0, 1) for patch in patches]).permute(0, 2, 3, 1).contiguous(),
        "units": torch.stack([patch.units for patch in patches]).float(),
        "centre": torch.stack([patch.centre for patch in patches]).float(),
        "metric": torch.stack([patch.metric[:rank] for patch in patches]),
        "mean": mean,
    }


def _padded(parts: Sequence[Tensor], value: float = 0) -> Tensor:
    """(P, longest, …) of P tensors (·, …)."""
    return nn.utils.rnn.pad_sequence(list(parts), batch_first=True, padding_value=value)


def output_rank(patches: Sequence[Patch]) -> int:
    """The smallest rank of the output that adds no more than SLACK to the squared error of all patches."""
    energy = _padded([patch.energy for patch in patches]).sum(dim=0)
    lost = energy.sum() - energy.cumsum(0)
    return min(int((lost > SLACK * sum(patch.error for patch in patches)).sum()) + 1, len(energy))


def padded_bases(patches: Sequence[Patch], rank: int) -> Tensor:
    """(P, S, rank) of their first axes; zeros beyond the entries and the axes of a patch."""
    return _padded([resized(patch.basis, rank) for patch in patches])


def resized(values: Tensor, size: int) -> Tensor:
    """The first ``size`` entries of the last dimension; zeros beyond."""
    return nn.functional.pad(values[..., :size], (0, max(0, size - values.shape[-1])))


def in_bytes(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Integers from −127 to 127, as floating-point numbers, and the factors along ``dim`` that make x of them."""
    unit = x.abs().amax(dim=dim, keepdim=True).clamp_min(1e-30) / 127
    return (x / unit).round(), unit


#: Candidates for the penalty, where the kernel is 1 at the centre.
PENALTIES = tuple(10.0 ** (k / 2) for k in range(-14, 1))
#: Most samples that a metric is learned from, and at how many of them gradients are computed.
SAMPLES, GRADIENTS = 800, 150
#: How often the metric is updated, and the power of the mean outer product of gradients that it is set to. With the
#: consistent power 1/2 it fits noise.
STEPS, POWER = 4, 0.25
#: The gradients are those of this many principal components of the values.
OUTPUTS = 16
#: The first metric is scaled so that the strongest coefficient has this root mean square.
SCALE = 1 / 8


def _kernel(s: Tensor) -> Tensor:
    """``κ(s)``, the exponential series to degree three."""
    return 1 + s * (1 + s * (1 / 2 + s / 6))


def _kernel_slope(s: Tensor) -> Tensor:
    """``κ'(s)``."""
    return 1 + s * (1 + s / 2)


def learned_metric(x: Tensor, y: Tensor, held_out: Pairs) -> Tensor:
    """A linear map A (k, k) of inputs x (n, k), z = x A, for which kernel ridge regression of y (n, q) is accurate.

    The kernel is ``κ(z·z') = 1 + s + s²/2 + s³/6``, s = z·z'. A starts as a multiple of the identity and is then set,
    several times, to a power of the mean outer product of the gradients of the regression, which shrinks the directions
    in which y does not change (recursive feature machines: Radhakrishnan et al., Science 383, 2024). Held-out pairs
    choose the penalty and the step.
    """
    x, y = x[:SAMPLES], y[:SAMPLES]
    components = principal_axes(y, by="svd")[1][:OUTPUTS].T
    metric = SCALE * torch.eye(x.shape[1], dtype=x.dtype)
    size = (x @ metric).square().sum()
    best, chosen = math.inf, metric
    for step in range(STEPS + 1):
        z = x @ metric
        s = z @ z.T
        found = SpectralRidge.fit(_kernel(s), y, (_kernel(held_out[0] @ metric @ z.T), held_out[1]), PENALTIES)
        if found.error < best:
            best, chosen = found.error, metric
        if step < STEPS:
            metric = _updated(metric, z, s[:GRADIENTS], found.weights @ components)
            metric = metric * (size / (x @ metric).square().sum().clamp_min(1e-30)).sqrt()
    return chosen


def _updated(metric: Tensor, z: Tensor, s: Tensor, weights: Tensor) -> Tensor:
    """A power of the mean outer product of gradients, up to a factor.

    Args:
        metric: A (k, k).
        z: (n, k) = x A.
        s: (m, n) inner products of the samples at which gradients are taken, with all.
        weights: (n, q) of the kernel regression.
    """
    gradients = torch.einsum("pn,nq,nk->pqk", _kernel_slope(s), weights, z).flatten(0, 1) @ metric.T
    value, vector = torch.linalg.eigh(gradients.T @ gradients)
    return vector * (value / value[-1].clamp_min(1e-30)).clamp_min(1e-12) ** POWER
