"""Sparse principal geodesic analysis: modes that each move a small part of the surface.

Minimise over tangent u_j and coefficients w, with the notation of `modes`,

    ‖V − U W‖² + λ Σ_j ‖u_j‖_{1,z̄},   |w_j|_∞ ≤ 1,   ‖u‖_{1,z̄} = Σ_e |u_l| / l̄ + η l̄ a^{-1/2} |u_θ|,

the norm of the paper for p = 1. The problem is convex in each mode and in W, but not in both together. So one block
after the other is solved, and the objective never rises.

- A mode u_j alone is the tangent vector that minimises ``|w_j|² ‖u − t‖² + λ ‖u‖_1``, where t is the remainder after
  all other modes. ADMM splits u = J d from z = u. First d solves ``(M + Jᵀ G J) d = …``, where G is the diagonal of the
  metric, scaled to weigh as much as M on the logarithms. Then z is a soft threshold. The matrix is factorised once: it
  is the same for all modes and iterations, because the penalty G is scaled with |w_j|² like the other terms. A few
  iterations are enough, because z and its multiplier are kept.
- Modes with little overlap are solved together, which takes half the time. If their sum raises the objective, they all
  go a part of the way. The objective is convex in all modes, so at 1/k of the way of k modes it does not rise.
- W is least squares in a box, a small problem for each shape, solved by coordinate descent.

The iteration starts from the modes of the plain analysis, rotated to be as concentrated as possible (varimax). At λ = 0
this start is a minimum. It leads to as low an objective as a start from localised pieces, in fewer iterations than a
start from the modes without rotation.

The right sparsity depends on the shapes. By default λ is the largest value that raises the error of unseen shapes by at
most 2 %, compared with principal modes in the norm of vertices. Inner folds measure this error: modes are found without
some shapes, and the error is the mean distance of these shapes from the span of the modes. A short trial with the
smallest λ comes first. If it costs too much, modes are dense and nothing else is tried. Otherwise the search begins at
the largest λ, starts each λ from the modes of the one before, and does a few rounds. Only the chosen λ is solved to the
end, with all shapes.

What a sparsity costs in each norm is in benchmarks/NOTES.md.
"""

from dataclasses import replace

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.normal_matrix import NormalMatrix, QuadraticForm
from shapespace.coordinates.nric import WeightedNorm
from shapespace.shell.space import ShellSpace
from shapespace.solve.cholesky import analyse
from shapespace.training.runs.progress import progress
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.local_fields import local_fields, scale_of
from shapespace.training.space.modes import (
    NEGLIGIBLE,
    ModeProblem,
    Modes,
    Norm,
    coefficients,
    localisation,
    pga,
    validation_norm,
)
from shapespace.training.space.related import INNER_FOLDS, Related

#: ADMM iterations on modes before the next modes, and their over-relaxation, between 1 and 2.
ADMM_ITERATIONS, OVERRELAXATION = 5, 1.6
#: Most modes that are solved together, and the greatest sum of their couplings with one more, see `_groups`.
TOGETHER, COUPLED = 10, 0.3
#: Most rounds of the rotation at the start, and of coordinate descent on the coefficients.
VARIMAX_ROUNDS, SWEEPS = 200, 100
#: The iteration ends when the objective falls by less than this part of itself in `PATIENCE` rounds. The part is larger
#: in vertices: there the objective is a thousandth of its value in the shell's metric, and keeps falling long after the
#: modes have stopped changing.
TOLERANCE: dict[Norm, float] = {"mixed": 5e-3, "vertices": 5e-3, "shell": 1e-3}
PATIENCE = 10
#: The same where a sparsity is only tried: the part, and the rounds.
TRIAL_TOLERANCE, TRIAL_PATIENCE = 2e-2, 5
#: The sparsity is the first of these whose modes raise the error of held-out logarithms by at most a share of the error
#: of principal modes, or by a share of the logarithms' own length, which is negligible.
SPARSITIES = (0.128, 0.064, 0.032, 0.016, 0.008, 0.004, 0.002, 0.001, 0.0005)
ALLOWED_ERROR, NEGLIGIBLE_ERROR = 0.02, 1e-3
#: Inner folds are added until at least this number of shapes is held out.
HELD_OUT = 8


def find_modes(
    settings: ModeSettings,
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    count: int,
    related: Related | None = None,
    local: float = 0.0,
) -> Modes:
    """Find ``count`` modes of logarithms (n, V, 3) at a mean (V, 3), as configured, and of their ``local`` fields with
    this share of the variance. To choose the sparsity, shapes that are ``related`` are held out together. Raises
    ModeError if the count or the sparsity is not possible.
    """
    if local:
        n = len(fields)
        others = local_fields(space.reference.with_vertices(mean), fields)
        others *= scale_of(others, fields, local)
        every = np.concatenate([fields, others.reshape(-1, *mean.shape)])
        every_related = (related or Related.none(n)).with_local(others)
        found = find_modes(settings, space, mean, every, count, every_related)
        codes, explained = coefficients(space, mean, fields, found.vertices, settings.norm)
        spread = np.sqrt((found.coefficients[n:] ** 2).sum(axis=0) / n)
        return replace(found, coefficients=codes, explained=explained, spread=spread)
    if settings.sparsity == 0:
        return pga(space, mean, fields, count, settings.norm)
    return spga(
        space,
        mean,
        fields,
        count,
        None if settings.sparsity == "auto" else settings.sparsity,
        settings.norm,
        related=related,
        max_iterations=settings.max_iterations,
        tolerance=TOLERANCE[settings.norm],
    )


def spga(
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    count: int,
    sparsity: float | None,
    norm: Norm = "mixed",
    *,
    related: Related | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-3,
) -> Modes:
    """Sparse principal geodesic analysis: localised modes that still come close to the logarithms.

    The meaning of ``sparsity`` does not depend on the number of shapes, on their size or on the mesh. The result is
    deterministic.

    ``sparsity`` is λ as a share of ``max_j 2 |w_j|² ‖u_j‖² / ‖u_j‖_1`` over the modes of the plain analysis. At
    that price the last of these modes vanishes. 0 gives the span of the plain analysis. None chooses one of
    `SPARSITIES`, or plain modes where all cost too much, by errors in vertices, or in the norm "shell" where that
    is the norm. Logarithms are (n, V, 3) at X̄ (V, 3), and η of the space also weighs the angles in the 1-norm. For
    ``related`` see modes.mode_count, for ``tolerance`` see `TOLERANCE`. Raises ModeError if the count is not
    possible, or the sparsity leaves no mode.
    """
    problem = _SparseProblem(space, mean, fields, count, norm)
    if sparsity is None:
        related = related or Related.none(len(fields))
        sparsity = _chosen_sparsity(space, mean, fields, count, norm, related, max_iterations)
        if sparsity == 0:
            return pga(space, mean, fields, count, validation_norm(norm))
    D, W, highest = problem.start(count)
    converged, history = _alternate(problem, D, W, sparsity * highest, max_iterations, tolerance)
    return replace(problem.modes(D, converged, history), sparsity=sparsity)


class _SparseProblem(ModeProblem):
    """A mode problem with the 1-norm."""

    def __init__(self, space: ShellSpace, mean: FloatArray, fields: FloatArray, count: int, norm: Norm) -> None:
        super().__init__(space, mean, fields, count, norm)
        diagonal: FloatArray = self.H.diagonal()
        # Scale of the metric's diagonal that makes it weigh on the logarithms as much as the norm.
        self.penalty = 1.0 if norm == "shell" else self.total / float(diagonal @ ((self.J @ self.D.T) ** 2).sum(axis=1))
        self.G = self.penalty * diagonal
        eta = space.material.eta
        self.norm = WeightedNorm.of(space.reference.with_vertices(self.point.vertices), eta)
        # Σ w_l |u_l| + η Σ w_θ |u_θ|, from the squares w_l² and η w_θ².
        self.weights = np.sqrt(self.norm.squared * np.repeat([1, eta], space.connectivity.edge_count))

    def scaled(self, D: FloatArray) -> FloatArray:
        """Return fields (m, 3V) as lengths and angles (2E, m), in units of the metric's diagonal."""
        return np.sqrt(self.G)[:, None] * (self.J @ D.T)

    def one_norms(self, D: FloatArray) -> FloatArray:
        """Return ``‖J d‖_1`` (m,) of fields (m, 3V)."""
        return self.weights @ np.abs(self.J @ D.T)

    def start(self, count: int) -> tuple[FloatArray, FloatArray, float]:
        """Return concentrated modes (m, 3V) with the span of the principal modes, their coefficients, and the price at
        which the last principal mode vanishes.
        """
        D, W = self.principal(count)
        highest = self.highest_price(D, W)
        rotation = _varimax(self.scaled(D))
        return *_normalised(rotation.T @ D, rotation.T @ W), highest

    def highest_price(self, D: FloatArray, W: FloatArray) -> float:
        """Return the largest λ at which one of these modes lowers the objective.

        There ``(1−s)² E + s λ L`` starts to fall with s.
        """
        D, W = _normalised(D, W)
        return float((2 * self.energies(D, W) / self.one_norms(D)).max())


class _Trial:
    """Modes without the shapes of one inner fold, and their error on these shapes."""

    def __init__(
        self, space: ShellSpace, mean: FloatArray, kept: FloatArray, held: FloatArray, count: int, norm: Norm
    ) -> None:
        self._judge = ModeProblem(space, mean, kept, 1, validation_norm(norm))
        self._unseen = self._judge.balanced(held)
        self._problem = _SparseProblem(space, mean, kept, count, norm)
        *self._start, self._highest = self._problem.start(count)
        self._modes = [each.copy() for each in self._start]
        self.lengths = self._norms(self._unseen)  # (k,) of the held-out logarithms
        self.least = self._errors(self._judge.principal(count)[0])  # (k,) errors of principal modes

    def _norms(self, rows: FloatArray) -> FloatArray:
        return np.sqrt(np.einsum("kx,xk->k", rows, self._judge.M @ rows.T))

    def _errors(self, modes: FloatArray) -> FloatArray:
        """Return the distances (k,) of the held-out logarithms from the span of modes (m, 3V)."""
        lowered = self._judge.M @ modes.T
        W = np.linalg.lstsq(modes @ lowered, (self._unseen @ lowered).T, rcond=NEGLIGIBLE)[0]
        return self._norms(self._unseen - W.T @ modes)

    def errors(self, sparsity: float, max_iterations: int, *, again: bool) -> FloatArray:
        """Return errors (k,) of modes with a sparsity. They start from the modes of the call before, or ``again``."""
        D, W = [each.copy() for each in self._start] if again else self._modes
        _alternate(self._problem, D, W, sparsity * self._highest, max_iterations, TRIAL_TOLERANCE, TRIAL_PATIENCE)
        return self._errors(D)


def _chosen_sparsity(
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    count: int,
    norm: Norm,
    related: Related,
    max_iterations: int,
) -> float:
    """Return the largest sparsity that costs little on held-out shapes, see `SPARSITIES`; 0 if there is none."""
    folds = related.inner_folds() if related.groups > 1 else []
    enough = -(-HELD_OUT * len(folds) // related.originals)
    trials = []
    for held, kept in folds[:enough]:
        # About their own mean, fewer shapes would have too few modes to tell.
        about = related.about_mean_of(kept, fields) if related.groups >= INNER_FOLDS else fields
        trials.append(_Trial(space, mean, about[kept], about[held], min(count, len(kept)), norm))
    if not trials:
        return 0.0
    least = float(np.concatenate([trial.least for trial in trials]).mean())
    length = float(np.concatenate([trial.lengths for trial in trials]).mean())
    most = least + max(ALLOWED_ERROR * least, NEGLIGIBLE_ERROR * length)

    def cheap(sparsity: float, *, again: bool = False) -> bool:
        found = [trial.errors(sparsity, max_iterations, again=again) for trial in trials]
        return float(np.concatenate(found).mean()) <= most

    if not cheap(SPARSITIES[-1], again=True):
        return 0.0
    shares = progress(SPARSITIES, "finding modes that move one part each", "sparsity", len(SPARSITIES))
    return next((share for share in shares if cheap(share)), 0.0)


class _Shrinkage:
    """ADMM for ``argmin_d ‖d − t‖_M² + p ‖J d‖_1``, with a state for each mode that is kept between calls."""

    def __init__(self, problem: _SparseProblem, D: FloatArray) -> None:
        G, space = problem.G, problem.point.space
        # M + Jᵀ G J
        matrix, metric = NormalMatrix(space.connectivity), problem.shell + problem.penalty
        faces = problem.form.faces * (problem.shell + problem.penalty * np.eye(3)[:, :, None])
        entries = matrix.entries(problem.point.gradients, QuadraticForm(faces, problem.form.angles * metric))
        entries[matrix.pattern.diagonal] += problem.plain * problem.areas
        self._factor = analyse(matrix.pattern, space.backend).factorise(entries)
        self._J, self._M = problem.J, problem.M
        self._JtG = sparse.csr_array(problem.J.T @ sparse.diags_array(G))
        self._threshold = np.divide(problem.weights, 2 * G, out=np.zeros_like(G), where=G > 0)
        self._z = (self._J @ D.T).T
        self._y = np.zeros_like(self._z)

    def __call__(self, some: IntArray, targets: FloatArray, prices: FloatArray) -> FloatArray:
        """Improve some modes (k,) towards targets (k, 3V), at their prices (k,)."""
        z, y, threshold = self._z[some].T, self._y[some].T, prices * self._threshold[:, None]
        pull = self._M @ targets.T
        for _ in range(ADMM_ITERATIONS):
            d = self._factor.solve((pull + self._JtG @ (z - y)).T)
            y = OVERRELAXATION * (self._J @ d.T) + (1 - OVERRELAXATION) * z + y
            left = np.clip(y, -threshold, threshold)
            z, y = y - left, left
        self._z[some], self._y[some] = z.T, y.T
        return d


def _alternate(
    problem: _SparseProblem,
    D: FloatArray,
    W: FloatArray,
    price: float,
    max_iterations: int,
    tolerance: float,
    patience: int = PATIENCE,
) -> tuple[bool, list[dict[str, float]]]:
    """Minimise in place over modes D (m, 3V) and coefficients W (m, n), block by block, never uphill. Returns whether
    the iteration converged, and its history, see `Modes`.
    """
    shrink = _Shrinkage(problem, D)
    history: list[dict[str, float]] = []
    rounds = range(max_iterations + 1)
    # A trial has so few rounds that only the number of trials is shown.
    shown = rounds if patience < PATIENCE else progress(rounds, "improving the modes", "round, or fewer", len(rounds))
    for iteration in shown:
        MD = problem.M @ D.T
        gram, B, norms = D @ MD, D @ problem.MD, problem.one_norms(D)
        misfit = 1 + float(np.vdot(W @ W.T, gram) - 2 * np.vdot(W, B)) / problem.total
        penalty = price * float(norms.sum()) / problem.total
        support = localisation((problem.J @ D[norms > 0].T).T, problem.norm) if norms.any() else np.zeros(1)
        history.append(
            {
                "iteration": iteration,
                "objective": misfit + penalty,
                "misfit": misfit,
                "penalty": penalty,
                "support": float(support.mean()),
            }
        )
        if iteration >= patience:
            then, now = history[-1 - patience]["objective"], history[-1]["objective"]
            if then - now <= tolerance * now:
                return True, history
        _fit_in_box(gram, B, W)
        for some in _groups(gram, W):
            _improve(problem, shrink, D, W, some, price)
    return False, history


def _groups(gram: FloatArray, W: FloatArray) -> list[IntArray]:
    """Divide the modes into groups that are solved together, each of modes with little coupling.

    The coupling of two modes is the cosine of their coefficients times the cosine of their fields, without signs; the
    ``gram`` matrix (m, m) has the inner products of the fields. Modes without coefficients are left out.
    """
    others, squares = W @ W.T, gram.diagonal()
    sizes = np.outer(others.diagonal(), np.maximum(squares, 1e-300))
    coupling = np.abs(others * gram) / np.sqrt(np.maximum(sizes * sizes.T, 1e-300))
    left, groups = np.flatnonzero(others.diagonal()).tolist(), []
    while left:
        group = [left.pop(0)]
        while left and len(group) < TOGETHER:
            with_group = coupling[np.ix_(left, group)].sum(axis=1)
            nearest = int(with_group.argmin())
            if with_group[nearest] > COUPLED:
                break
            group.append(left.pop(nearest))
        groups.append(np.array(group))
    return groups


def _improve(
    problem: _SparseProblem, shrink: _Shrinkage, D: FloatArray, W: FloatArray, some: IntArray, price: float
) -> None:
    """Improve some modes (k,) of D (m, 3V) in place, so that the objective does not rise."""
    inner = W[some] @ W.T
    squares = inner[np.arange(len(some)), some]
    others = inner.copy()
    others[np.arange(len(some)), some] = 0
    targets = (W[some] @ problem.D - others @ D) / squares[:, None]
    before, lowered = D[some], problem.M @ targets.T

    def worth(d: FloatArray) -> FloatArray:
        """Return the objective with each of these fields (k, 3V) as its mode, less the objective without the mode."""
        fit = np.einsum("jx,xj->j", d, problem.M @ d.T - 2 * lowered)
        return squares * fit + price * problem.one_norms(d)

    # A few ADMM iterations may raise the objective, and a weak mode may cost more than it is worth.
    tried = np.stack([shrink(some, targets, price / squares), before, np.zeros_like(before)])
    step = tried[np.argmin([worth(d) for d in tried], axis=0), np.arange(len(some))] - before
    if len(some) > 1:
        moved = problem.M @ step.T
        curved = float(np.vdot(inner[:, some] @ step, moved.T))
        slope = 2 * float(np.vdot(inner @ D - W[some] @ problem.D, moved.T))
        least, share = float(problem.one_norms(before).sum()), 1.0

        def rises(share: float) -> bool:
            penalty = float(problem.one_norms(before + share * step).sum()) - least
            return share**2 * curved + share * slope + price * penalty > 0

        while share * len(some) > 1 and rises(share):
            share /= 2
        step *= share
    D[some] = before + step


def _fit_in_box(gram: FloatArray, B: FloatArray, W: FloatArray) -> None:
    """Minimise ``wᵀ gram w − 2 wᵀ b`` over |w|_∞ ≤ 1 for each column of B (m, n), in place, by coordinate descent."""
    for _ in range(SWEEPS):
        before = W.copy()
        for j in np.flatnonzero(gram.diagonal()):
            W[j] = np.clip(W[j] + (B[j] - gram[j] @ W) / gram[j, j], -1, 1)
        if np.abs(W - before).max() < 1e-9:
            break


def _normalised(D: FloatArray, W: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale fields and coefficients to ``|w_j|_∞ = 1``, with the same product ``Dᵀ W``."""
    largest = np.abs(W).max(axis=1, keepdims=True)
    return D * largest, W / largest


def _varimax(loadings: FloatArray) -> FloatArray:
    """Return the rotation (m, m) of maximal variance of the squares of loadings (p, m), by SVD (Kaiser 1958)."""
    rotation, before = np.eye(loadings.shape[1]), 0.0
    for _ in range(VARIMAX_ROUNDS):
        turned = loadings @ rotation
        left, values, right = np.linalg.svd(loadings.T @ (turned**3 - turned * (turned**2).mean(axis=0)))
        rotation = left @ right
        if values.sum() < before * (1 + 1e-7):
            break
        before = values.sum()
    return rotation
