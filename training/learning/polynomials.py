"""A correction of the joint shape by polynomials in the factors' shapes, one for each patch of edges."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.training.learning.layers import half_precision, patch_entries
from shapespace.training.runs.progress import progress

#: What is fitted to, or chosen by: factor shapes (n, J, 2E) and what is missed of the joint one (n, 2E).
Pairs = tuple[Tensor, Tensor]


class PatchPolynomials(nn.Module):
    """A correction of the joint shape, (n, J, 2E) → (n, 2E): cubic in the factors' shapes, patch by patch.

    What factors do to each other on an edge depends on what each of them does there. So in each patch of neighbouring
    edges every factor's shape is brought to a few principal coefficients, and the correction is a polynomial in those
    of all factors. There are more of them than samples tell apart, but few directions among them matter. Which is
    learned first (`learned_metric`). In the coordinates of that metric the kernel ``1 + s + s²/2 + s³/6`` is a sum over
    monomials, and those that it gives most weight are kept: a map of fixed size, however many samples there were.
    """

    entries: Tensor
    place: Tensor
    axes: Tensor
    units: Tensor
    centre: Tensor
    metric: Tensor
    pairs: Tensor
    triples: Tensor
    weights: Tensor
    gains: Tensor
    basis: Tensor
    mean: Tensor
    #: Edges of a patch, on average.
    EDGES = 24
    #: Samples that the principal axes of factors are taken from, at most.
    AXES = 500
    #: Share of the error on held-out samples that a lower rank of the last layers may cost.
    SLACK = 0.125

    def __init__(self, shapes: Mapping[str, torch.Size]) -> None:
        super().__init__()
        for name, shape in shapes.items():
            whole = name in ("entries", "place", "pairs", "triples")
            self.register_buffer(name, torch.zeros(shape, dtype=torch.int64 if whole else torch.float32))

    @classmethod
    def blank(cls, tensors: Mapping[str, Tensor]) -> PatchPolynomials:
        """One of the sizes of a saved one, to load it into; ``tensors`` are the saved one's, by their own names."""
        return cls({name: tensor.shape for name, tensor in tensors.items()})

    @classmethod
    def fit(
        cls, coefficients: int, monomials: int, midpoints: FloatArray, own: Pairs, held_out: Pairs, seed: int
    ) -> PatchPolynomials:
        """Fit to what is missed so far, all of it as scaled differences.

        Args:
            coefficients: of each factor in a patch.
            monomials: of second and third degree that are kept, in each patch.
            midpoints: (E, 3) of the edges.
            own: what is fitted to.
            held_out: what chooses penalties and metrics.
            seed: of the patches.
        """
        entries = patch_entries(midpoints, math.ceil(len(midpoints) / cls.EDGES), seed)
        patches = [_Patch(columns, coefficients, own[0][: cls.AXES]) for columns in entries]
        for patch in progress(patches, "metrics", "patch"):
            patch.learn_metric(own, held_out)
        spread = torch.stack([patch.spread for patch in patches]).clamp_min(1e-30).log().mean(dim=0)
        pairs, triples = _strongest(spread.numpy(), monomials)
        rank = 1 + int(np.concatenate([pairs.ravel(), triples.ravel()]).max(initial=0))
        roots = torch.cat([torch.ones(rank), _roots(pairs), _roots(triples)])
        for patch in progress(patches, "polynomials", "patch"):
            patch.fit(own, held_out, rank, pairs, triples, roots)
        return cls._of(patches, rank, pairs, triples, own[1].shape[1])

    @classmethod
    def _of(cls, patches: list[_Patch], rank: int, pairs: NDArray, triples: NDArray, size: int) -> PatchPolynomials:
        energy = nn.utils.rnn.pad_sequence([patch.energy for patch in patches], batch_first=True).sum(dim=0)
        lost = energy.sum() - energy.cumsum(0)
        allowed = cls.SLACK * sum(patch.error for patch in patches)
        count = min(int((lost > allowed).sum()) + 1, len(energy))

        # Short patches are filled up with an entry that isn't there, which counts for nothing.
        widest = max(len(patch.columns) for patch in patches)
        factors, coefficients, _ = patches[0].axes.shape
        entries = torch.full((len(patches), widest), size)
        axes = torch.zeros(len(patches), factors, coefficients, widest)
        weights = torch.zeros(len(patches), count, rank + len(pairs) + len(triples))
        gains = torch.zeros(len(patches), count)
        basis = torch.zeros(len(patches), widest, count)
        mean = torch.zeros(size)
        for p, patch in enumerate(patches):
            columns, own = patch.columns, patch.basis[:, :count]
            found = own.T @ patch.weights
            entries[p, : len(columns)] = torch.as_tensor(columns)
            axes[p, :, :, : len(columns)] = patch.axes
            weights[p, : len(found)], first = in_bytes(found, dim=1)
            basis[p, : len(columns), : len(found)], second = in_bytes(own, dim=0)
            gains[p, : len(found)] = first.flatten() * second.flatten()
            mean[columns] = patch.mean.float()
        tensors = {
            "entries": entries,
            "place": torch.argsort(entries.flatten())[:size],
            "axes": axes,
            "units": torch.stack([patch.units for patch in patches]).float(),
            "centre": torch.stack([patch.centre for patch in patches]).float(),
            "metric": torch.stack([patch.metric[:rank] for patch in patches]),
            "pairs": torch.as_tensor(pairs.T.copy()),
            "triples": torch.as_tensor(triples.T.copy()),
            "weights": weights,
            "gains": gains,
            "basis": basis,
            "mean": mean,
        }
        result = cls.blank(tensors)
        result.load_state_dict(tensors)
        return result

    def forward(self, y: Tensor) -> Tensor:
        # Codes come last: so gathers copy rows, and products of small matrices take few steps in the runtime.
        rows = torch.cat([y, torch.zeros_like(y[:, :, :1])], dim=2).permute(2, 1, 0)
        local = rows.index_select(0, self.entries.flatten()).unflatten(0, self.entries.shape).transpose(1, 2)
        c = (self.axes @ local).flatten(1, 2) * self.units[:, :, None] - self.centre[:, :, None]
        u = (self.metric @ c).transpose(0, 1)
        parts = u, _products(u, self.pairs), _products(u, self.triples)
        found = torch.cat([part.transpose(0, 1) for part in parts], dim=1)
        out = (self.basis @ (self.weights @ found * self.gains[:, :, None])).flatten(0, 1)
        return out.index_select(0, self.place).T + self.mean


def in_bytes(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Whole numbers from −127 to 127, and the unit along ``dim`` in which they are x."""
    unit = x.abs().amax(dim=dim, keepdim=True).clamp_min(1e-30) / 127
    return (x / unit).round(), unit


def _products(u: Tensor, factors: Tensor) -> Tensor:
    """(k, …) products of coordinates u (r, …), each of those that a column of ``factors`` names."""
    result = u.index_select(0, factors[0])
    for index in factors[1:]:
        result = result * u.index_select(0, index)
    return result


def _factorial(index: Sequence[int] | NDArray) -> int:
    """``β!`` of the monomial ``x^β`` that is the product of these coordinates."""
    return math.prod(map(math.factorial, np.bincount(index)))


def _strongest(spread: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """The pairs (k, 2) and triples (l, 3) of coordinates whose monomials the kernel gives most weight.

    In ``s^k / k!`` the monomial ``x^β`` has the weight ``x^β x'^β / β!``. Coordinates have the logarithms ``spread`` of
    their mean squares, falling.
    """
    found = [
        (sum(spread[list(index)]) - math.log(_factorial(index)), index)
        for degree in (2, 3)
        for index in itertools.combinations_with_replacement(range(len(spread)), degree)
    ]
    kept = [index for _, index in sorted(found, reverse=True)[:count]]
    pairs, triples = ([index for index in kept if len(index) == degree] for degree in (2, 3))
    return np.array(pairs, dtype=int).reshape(-1, 2), np.array(triples, dtype=int).reshape(-1, 3)


class _Patch:
    """One patch while it is fitted.

    Attributes:
        columns: (S,) its entries, lengths and then angles.
        axes: (J, d, S) principal axes of the factors' shapes there, numbers of a byte.
        units: (J d,) of the axes, in which the widest coefficient has a variance of one.
        centre: (J d,) coefficients of their mean.
        metric: (J d, J d) a row for each coordinate, the strongest first, that it is of the coefficients.
        spread: (J d,) mean squares of these.
        weights: (S, monomials) of the polynomial without its constant.
        basis: (S, k) principal axes of what it finds.
        energy: (k,) its mean squares along them.
        error: mean square of what it misses of held-out samples.
        mean: (S,) its constant.
    """

    def __init__(self, columns: NDArray, coefficients: int, y: Tensor) -> None:
        self.columns, axes, centre, widest = columns, [], [], 0.0
        for shapes in y[:, :, columns].double().unbind(1):
            middle = shapes.mean(dim=0)
            _, s, vt = torch.linalg.svd(shapes - middle, full_matrices=False)
            vt = nn.functional.pad(vt[:coefficients], (0, 0, 0, max(0, coefficients - len(vt))))
            axes.append(vt)
            centre.append(vt @ middle)
            widest = max(widest, float(s[0]) / len(y) ** 0.5)
        whole, unit = in_bytes(torch.stack(axes), dim=2)
        self.axes = whole.float()
        self.units = unit.flatten() / max(widest, 1e-12)
        self.centre = torch.cat(centre) / max(widest, 1e-12)

    def _inputs(self, y: Tensor) -> Tensor:
        """(n, J d) coefficients of factor shapes (n, J, 2E)."""
        c = torch.einsum("njs,jds->njd", y[:, :, self.columns].double(), self.axes.double())
        return c.flatten(1) * self.units - self.centre

    def learn_metric(self, own: Pairs, held_out: Pairs) -> None:
        """Find the coordinates in which the correction is a polynomial."""
        x, other = self._inputs(own[0]), self._inputs(held_out[0])
        wanted, theirs = (pairs[1][:, self.columns].double() for pairs in (own, held_out))
        self.mean = wanted.mean(dim=0)
        metric, self.penalty = learned_metric(x, wanted - self.mean, (other, theirs - self.mean))
        # The kernel knows no axes: with those of the samples, few monomials carry most of it.
        z = x @ metric
        value, axes = torch.linalg.eigh(z.T @ z / len(z))
        self.metric, self.spread = half_precision((metric @ axes.flip(1)).T.float()), value.flip(0)

    def _features(self, y: Tensor, rank: int, pairs: NDArray, triples: NDArray, roots: Tensor) -> Tensor:
        """(n, 1 + r + …) monomials, weighted as the kernel does."""
        u = self.metric[:rank].double() @ self._inputs(y).T
        products = (_products(u, torch.as_tensor(index.T)) for index in (pairs, triples))
        return torch.cat([torch.ones_like(u[:1]), torch.cat([u, *products]) * roots[:, None]]).T

    def fit(self, own: Pairs, held_out: Pairs, rank: int, pairs: NDArray, triples: NDArray, roots: Tensor) -> None:
        """Ridge regression on the monomials, whose weights in the kernel have these square roots."""
        x, other = (self._features(y, rank, pairs, triples, roots) for y in (own[0], held_out[0]))
        wanted, theirs = (residual[:, self.columns].double() - self.mean for _, residual in (own, held_out))
        dual = len(x) < x.shape[1]
        square, right = (x @ x.T, wanted) if dual else (x.T @ x, x.T @ wanted)
        best = math.inf
        for penalty in (max(self.penalty / 10, PENALTIES[0]), self.penalty, 10 * self.penalty):
            half = torch.linalg.cholesky(square + penalty * torch.eye(len(square)))
            found = torch.cholesky_solve(right, half)
            found = x.T @ found if dual else found
            error = float((other @ found - theirs).square().sum())
            if error < best:
                best, weights = error, found
        self.mean = self.mean + weights[0]
        told = x[:, 1:] @ weights[1:]
        self.error = best / len(other)
        value, vector = torch.linalg.eigh(told.T @ told / len(told))
        self.energy, self.basis = value.flip(0).clamp_min(0), vector.flip(1).float()
        self.weights = (weights[1:] * roots[:, None]).T.float()


def _roots(index: NDArray) -> Tensor:
    """(k,) ``1 / √β!`` of monomials ``x^β`` given as rows of coordinates."""
    return torch.tensor([_factorial(row) for row in index], dtype=torch.float64).rsqrt()


#: Penalties that held-out samples choose from.
PENALTIES = tuple(10.0 ** (k / 2) for k in range(-14, 1))
#: Samples that a metric is learned from, at most, and those of them at which gradients are taken.
SAMPLES, GRADIENTS = 800, 150
#: Times that it is learned anew, and the power of the gradients' mean outer product that it becomes: less than the half
#: that would be consistent, which follows noise.
STEPS, POWER = 4, 0.25
#: Principal components of what is fitted whose gradients count.
OUTPUTS = 16
#: Root mean square of the strongest coefficient in the kernel's coordinates, to begin with.
SCALE = 1 / 8


def _kernel(s: Tensor) -> Tensor:
    """``κ(s)``, the exponential's first terms."""
    return 1 + s + s**2 / 2 + s**3 / 6


def learned_metric(x: Tensor, y: Tensor, held_out: tuple[Tensor, Tensor]) -> tuple[Tensor, float]:
    """A linear map (k, k) of inputs x (n, k), after which kernel ridge regression with ``κ(z·z')`` suits y (n, q) best.

    ``κ(s) = 1 + s + s²/2 + s³/6``. The map starts as a multiple of the identity. Then it is made, several times, a root
    of the mean outer product of the gradients of what was found with it: directions along which nothing changes fade
    (recursive feature machines: Radhakrishnan et al., Science 383, 2024). Held-out pairs choose the penalty and the
    step.

    Returns:
        The map, and the penalty that suited it.
    """
    x, y = x[:SAMPLES], y[:SAMPLES]
    components = torch.linalg.svd(y, full_matrices=False)[2][:OUTPUTS].T
    metric = SCALE * torch.eye(x.shape[1], dtype=x.dtype)
    total = (x @ metric).square().sum()
    best, chosen = math.inf, (metric, PENALTIES[-1])
    for step in range(STEPS + 1):
        z = x @ metric
        s = z @ z.T
        value, vector = torch.linalg.eigh(_kernel(s))
        right = vector.T @ y
        other = _kernel(held_out[0] @ metric @ z.T) @ vector
        found = {p: right / (value.clamp_min(0) + p)[:, None] for p in PENALTIES}
        errors = {p: float((other @ spectrum - held_out[1]).square().sum()) for p, spectrum in found.items()}
        penalty = min(errors, key=errors.__getitem__)
        if errors[penalty] < best:
            best, chosen = errors[penalty], (metric, penalty)
        if step < STEPS:
            s = s[:GRADIENTS]
            weights = vector @ found[penalty] @ components
            gradients = torch.einsum("pn,nq,nk->pqk", 1 + s + s**2 / 2, weights, z).flatten(0, 1) @ metric.T
            value, vector = torch.linalg.eigh(gradients.T @ gradients)
            metric = vector * (value / value[-1].clamp_min(1e-30)).clamp_min(1e-12) ** POWER
            metric = metric * (total / (x @ metric).square().sum().clamp_min(1e-30)).sqrt()
    return chosen
