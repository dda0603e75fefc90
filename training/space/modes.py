"""Principal geodesic analysis, plain and sparse: the directions in which the shapes of a collection differ.

The shapes z^i are carried to the tangent space at their mean z̄ by the discrete logarithm, v^i = log_z̄ z^i, and a few
modes u_j are sought whose combinations come close to them (paper, section 3). Everything is computed in vertex fields d
(V, 3), of which ``u = J d`` with ``J = Dz(X̄)`` are the changes of lengths and angles: then u is tangent whatever d is,
and the misfit of modes is measured by one sparse matrix M, ``‖u‖² = dᵀ M d``:

- "vertices": M holds the areas of the vertices, and d is the smallest motion with these changes. It measures where a
  limb points, as users see it, but hardly creases: exponentials of sparse modes then soon collapse a face.
- "shell", the paper's: the metric, ``M = ½ Jᵀ Hess₂W[z̄, z̄] J``. It weighs wrinkles strongly, and where a limb points
  hardly at all.
- "mixed": the first plus a tenth of the second, scaled so that the logarithms weigh the same in both.

The logarithms are not centred again: at the Riemannian centre of mass their sum is zero, at the centred mean nearly so.

**Sparse modes.** Minimise over tangent u_j and coefficients w

    ‖V − U W‖² + λ Σ_j ‖u_j‖_{1,z̄},   |w_j|_∞ ≤ 1,   ‖u‖_{1,z̄} = Σ_e |u_l| / l̄ + η l̄ a^{-1/2} |u_θ|,

the norm that the paper gives for p = 1. The problem is convex in each mode and in W, not in both, so one block after
the other is solved and the objective never rises.

- A mode u_j alone asks for the tangent vector that minimises ``|w_j|² ‖u − t‖² + λ ‖u‖_1``, with t what the other
  modes leave. ADMM splits u = J d from z = u: d solves ``(M + Jᵀ G J) d = …``, with G the diagonal of the metric,
  scaled to weigh as much as M on the logarithms, and z is a soft threshold. The matrix is the same for all modes and
  all iterations because the penalty G is scaled with |w_j|² like the rest: it is factorised once. A few iterations are
  enough, as z and its multiplier are kept.
- W is least squares in a box, a small problem for each shape, by coordinate descent.

The start is the modes of the plain analysis rotated among themselves to be as concentrated as they can (varimax):
at λ = 0 that is a minimum already, and it ends as low as a start from localised pieces and sooner than one from the
modes as they are.

How sparse they may be depends on the shapes: what no other shape has is lost on those that are held out anyhow, and so
much sparsity costs nothing. By default λ is the largest that adds 3 % at most to the square of their error, which is
estimated with principal modes in inner folds.

What sparsity costs and brings, share explained / mean share of edges that carry 95 % of a mode, measured at η = 1e-4 on
a hand (57 poses, m = 12), a captured dancer (60, m = 20) and a posed body (44, m = 20); in the norms with vertices on
four fifths of these, whose plain modes are rotated first, and explained in that of vertices:

| sparsity, mixed | hand | dancer | body |
|---|---|---|---|
| plain | 0.9994 / 0.15 | 0.9978 / 0.37 | 0.9995 / 0.22 |
| 0.001 | 0.9994 / 0.12 | 0.9977 / 0.30 | 0.9994 / 0.09 |
| 0.002 | 0.9994 / 0.10 | 0.9975 / 0.26 | 0.9993 / 0.07 |
| 0.005 | 0.9993 / 0.08 | 0.9964 / 0.19 | 0.9988 / 0.05 |
| 0.01 | 0.9991 / 0.06 | 0.9949 / 0.15 | 0.9982 / 0.04 |

| sparsity, by vertices | hand | dancer | body |
|---|---|---|---|
| plain | 0.9995 / 0.15 | 0.9979 / 0.37 | 0.9996 / 0.23 |
| 0.0001 | 0.9995 / 0.10 | 0.9978 / 0.27 | 0.9995 / 0.08 |
| 0.0003 | 0.9994 / 0.09 | 0.9975 / 0.21 | 0.9993 / 0.05 |
| 0.001 | 0.9991 / 0.07 | 0.9966 / 0.14 | 0.9988 / 0.04 |

| sparsity, by the shell | hand | dancer | body |
|---|---|---|---|
| plain | 0.983 / 0.20 | 0.943 / 0.38 | 0.969 / 0.31 |
| 0.03 | 0.980 / 0.07 | 0.939 / 0.28 | |
| 0.1 | 0.970 / 0.06 | 0.916 / 0.20 | 0.917 / 0.04 |
| 0.2 | | 0.878 / 0.14 | |
| 0.3 | 0.929 / 0.05 | 0.837 / 0.11 | |
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.normal_matrix import NormalMatrix, QuadraticForm
from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.rigid_motion import rigid_motions, without_rigid_motion
from shapespace.mesh.triangle_mesh import vertex_areas
from shapespace.shell.space import ShellPoint, ShellSpace
from shapespace.solve.cholesky import SymmetricPattern, analyse
from shapespace.training.runs.config import ModeSettings

#: In which the misfit of modes to logarithms is measured.
Norm = Literal["mixed", "vertices", "shell"]
#: Most rounds through all sparse modes.
ITERATIONS = ModeSettings().max_iterations
#: ADMM iterations on a mode before the next has its turn, and their over-relaxation.
INNER_ITERATIONS = 10
OVERRELAXATION = 1.6
#: Most rounds of the rotation at the start, and of coordinate descent on the coefficients.
VARIMAX_ITERATIONS, SWEEPS = 200, 100
#: The objective is compared with that of so many iterations ago.
PATIENCE = 10
#: Default tolerances of spga, by norm. In vertices it may end sooner: there the objective is a thousandth of that in
#: the shell's metric, and keeps falling long after the modes have stopped changing.
TOLERANCE: dict[Norm, float] = {"mixed": 5e-3, "vertices": 5e-3, "shell": 1e-3}
#: In the mixed norm: square norm of the logarithms in the shell's metric, as a share of that in the norm of vertices.
SHELL = 0.1
#: Modes with a smaller share of the total energy are dropped: they are round-off.
NEGLIGIBLE = 1e-9
#: A mode is as local as the share of the edges that carries this part of its square norm.
LOCAL = 0.95
#: To choose the number of modes: number of inner folds, and by how much a further mode has to lower the mean error of
#: held-out logarithms, as a share of their mean length.
INNER_FOLDS, WORTH = 5, 0.005
#: To choose the sparsity: how much it may add to the squared error of held-out logarithms, as a share of the error of
#: as many principal modes; and the candidates, of which the largest that does not add more is taken.
SPENT = 0.03
SPARSITIES = [0.128, 0.064, 0.032, 0.016, 0.008, 0.004, 0.002, 0.001, 0.0005]


class ModeError(ValueError):
    """Modes that can't be computed as asked, with a sentence that says why."""


@dataclass(frozen=True)
class Modes:
    """Directions in the tangent space at a mean, strongest first, and where the shapes lie along them.

    Each is scaled so that the largest coefficient of a shape is 1, and positive. There may be fewer than asked for:
    a mode that carries nothing is left out.

    Attributes:
        nric: (m, 2E) changes u_j of lengths and angles.
        vertices: (m, V, 3) vertex fields d_j, without rigid motion, u_j = J d_j.
        coefficients: (n, m) orthogonal projections, in the norm, of the shapes' logarithms.
        explained: share of ``Σ ‖v^i‖²`` that the projections keep.
        converged: whether the iteration ended by itself.
        sparsity: λ, see ``spga``.
        history: of the sparse analysis, for each iteration ``iteration, objective, misfit, penalty`` (objective =
            misfit + penalty, as shares of ``Σ ‖v^i‖²``) and ``support``, the mean of ``localisation``.
    """

    nric: FloatArray
    vertices: FloatArray
    coefficients: FloatArray
    explained: float
    converged: bool = True
    sparsity: float = 0.0
    history: list[dict[str, float]] = field(default_factory=list, repr=False)

    def __len__(self) -> int:
        return len(self.vertices)


def pga(space: ShellSpace, mean: FloatArray, fields: FloatArray, count: int, norm: Norm = "mixed") -> Modes:
    """Principal geodesic analysis: the modes whose span comes closest to the logarithms.

    Args:
        space: the shape space.
        mean: X̄ (V, 3).
        fields: (n, V, 3) logarithms.
        count: m, at most n.
        norm: in which.

    Raises:
        ModeError: a count that is not possible, or fields without anything in them.
    """
    problem = _ModeProblem(space, mean, fields, count, norm)
    return problem.modes(problem.principal(count)[0])


def spga(
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    count: int,
    sparsity: float | None,
    norm: Norm = "mixed",
    *,
    original_index: IntArray | None = None,
    max_iterations: int = ITERATIONS,
    tolerance: float = 1e-3,
) -> Modes:
    """Sparse principal geodesic analysis: localised modes that still come close to the logarithms.

    ``sparsity`` does not depend on the number of shapes, on their size or on the mesh. Nothing here is random.

    Args:
        space: the shape space; its η also weighs the angles in the 1-norm.
        mean: X̄ (V, 3).
        fields: (n, V, 3) logarithms.
        count: m, at most n.
        sparsity: λ, or None for the largest of SPARSITIES that adds no more than SPENT to the square of what as many
            principal modes leave of logarithms that are held out, in vertices unless the norm is the shell's. As a
            share of ``max_j 2 |w_j|² ‖u_j‖² / ‖u_j‖_1`` over the modes of the plain analysis, the price at which the
            last of them, scaled down to nothing, is worth no more; 0 gives the span of the plain analysis.
        norm: of the misfit.
        original_index: see `worthwhile`.
        max_iterations: rounds through all modes.
        tolerance: ends when the objective fell by less than this part of itself in ten rounds.

    Raises:
        ModeError: a count or sparsity that is not possible, or a sparsity that leaves no mode.
    """
    if sparsity is not None and not 0 <= sparsity < np.inf:
        raise ModeError(f"sparsity must be a number from 0 up, not {sparsity}")
    problem = _ModeProblem(space, mean, fields, count, norm)
    D, W = problem.principal(count)
    highest = problem.highest_price(D, W)
    enough = _SparsityCriterion(space, mean, fields, D, norm, original_index) if sparsity is None else None
    rotation = _varimax(problem.scaled(D))
    D, W = _normalised(rotation.T @ D, rotation.T @ W)
    for share in SPARSITIES if sparsity is None else [sparsity]:
        converged, history = _alternate(problem, D, W, share * highest, max_iterations, tolerance)
        if enough and enough(D):
            break
    return replace(problem.modes(D, converged, history), sparsity=share)


def mode_count(
    settings: ModeSettings,
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    original_index: IntArray | None = None,
) -> int:
    """How many modes settings give for logarithms (n, V, 3) of shapes (n,) at a mean (V, 3), less than n."""
    asked = (
        worthwhile(space, mean, fields, settings.norm, original_index) if settings.count == "auto" else settings.count
    )
    return max(1, min(asked, len(fields) - 1))


def find_modes(
    settings: ModeSettings,
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    count: int,
    original_index: IntArray | None = None,
) -> Modes:
    """So many modes of logarithms (n, V, 3) of shapes (n,) at a mean (V, 3), as settings say; raises ModeError."""
    if settings.sparsity == 0:
        return pga(space, mean, fields, count, settings.norm)
    return spga(
        space,
        mean,
        fields,
        count,
        None if settings.sparsity == "auto" else settings.sparsity,
        settings.norm,
        original_index=original_index,
        max_iterations=settings.max_iterations,
        tolerance=TOLERANCE[settings.norm],
    )


def worthwhile(
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    norm: Norm = "vertices",
    original_index: IntArray | None = None,
) -> int:
    """How many modes pay.

    The m that minimises ``error(m) + WORTH · m``, with the error of what m principal modes of the other shapes leave of
    logarithms that are held out, as a share of their length. Nothing is shot: a run's figures of generalisation are
    those of shapes that took part in this.

    Args:
        space: the shape space.
        mean: X̄ (V, 3).
        fields: (n, V, 3) logarithms.
        norm: in which.
        original_index: (n,) the shape that each is of, from 0; a shape and its mirror image are held out together.

    Raises:
        ModeError: fields that can't be used.
    """
    left = np.sqrt(_ModeProblem(space, mean, fields, 1, _judged(norm)).left_of_held_out(original_index))
    errors = left.mean(axis=0) / left[:, 0].mean()
    return max(1, int(np.argmin(errors + WORTH * np.arange(len(fields)))))


def _judged(norm: Norm) -> Norm:
    """In which norm shapes that are held out are missed: in a mixed one the shell is there for smoothness only."""
    return "shell" if norm == "shell" else "vertices"


def coefficients(
    space: ShellSpace, mean: FloatArray, fields: FloatArray, modes: FloatArray, norm: Norm
) -> tuple[FloatArray, float]:
    """Of the orthogonal projections of logarithms to the span of modes.

    Args:
        space: the shape space.
        mean: X̄ (V, 3).
        fields: (n, V, 3) logarithms.
        modes: (m, V, 3) vertex fields.
        norm: in which.

    Returns:
        (n, m), and the share of ``Σ ‖v^i‖²`` that the projections keep.

    Raises:
        ModeError: logarithms that can't be used.
    """
    problem = _ModeProblem(space, mean, fields, 1, norm)
    W, explained = problem.project(problem.balanced(modes))
    return W.T, explained


def edge_magnitudes(nric: FloatArray, norm: WeightedNorm) -> FloatArray:
    """How much each edge (…, E) has of a change (…, 2E) of lengths and angles, in a weighted norm."""
    lengths, angles = np.split(nric**2 * norm.squared, 2, axis=-1)
    return np.sqrt(lengths + angles)


def localisation(nric: FloatArray, norm: WeightedNorm) -> FloatArray:
    """The smallest part of all edges that carries LOCAL of each mode's square ``‖u_j‖²``.

    Args:
        nric: (m, 2E) modes.
        norm: at their mean.

    Returns:
        (m,) between 1/E and 1.
    """
    squares = np.sort(edge_magnitudes(nric, norm) ** 2, axis=1)[:, ::-1].cumsum(axis=1)
    return ((squares < LOCAL * squares[:, -1:]).sum(axis=1) + 1) / squares.shape[1]


class _ModeProblem:
    """The tangent space at a mean with the logarithms in it, all as matrices on flat vertex fields (3V,).

    Attributes:
        areas: (3V,) of the vertices, 1 on average.
        plain: weight of the norm of vertices.
        shell: weight of the shell's metric.
        M: (3V, 3V) the norm.
        D: (n, 3V) the logarithms.
        MD: (3V, n) lowered by the norm.
        total: ``Σ ‖v^i‖²``.
        weights: (2E,) of the 1-norm.
        G: (2E,) the diagonal of the metric, scaled by the penalty to weigh on the logarithms as much as the norm.
    """

    def __init__(self, space: ShellSpace, mean: FloatArray, fields: FloatArray, count: int, norm: Norm) -> None:
        self.point: ShellPoint = space.point(mean)
        fields = np.asarray(fields, dtype=np.float64)
        if fields.ndim != 3 or fields.shape[1:] != self.point.vertices.shape:
            raise ModeError(f"fields must be (n, {len(self.point.vertices)}, 3), not {fields.shape}")
        if not np.isfinite(fields).all():
            raise ModeError("a field has an entry that is not finite")
        if not 1 <= count <= len(fields):
            raise ModeError(f"the number of modes must be from 1 to the number of shapes, {len(fields)}, not {count}")
        hessian = self.point.hessian
        self.form = QuadraticForm(hessian.faces / 2, hessian.angles / 2)
        self.J = space.jacobian.matrix(self.point.gradients)
        H = _matrix(self.form, space.energy.sides, space.connectivity.edge_count)
        areas = vertex_areas(self.point.vertices, space.connectivity.faces)
        self.areas = np.repeat(areas / areas.mean(), 3)
        self.D = self.balanced(fields)
        plain, metric = sparse.diags_array(self.areas), self.J.T @ H @ self.J
        moved, strained = (float(np.vdot(self.D.T, matrix @ self.D.T)) for matrix in (plain, metric))
        if not strained > 0:
            raise ModeError("there are no modes: all shapes are the same as the mean")
        self.plain = float(norm != "shell")
        self.shell = {"mixed": SHELL * moved / strained, "vertices": 0.0, "shell": 1.0}[norm]
        self.M = sparse.csr_array(self.plain * plain + self.shell * metric)
        self.MD = self.M @ self.D.T
        self.total = float(np.vdot(self.D.T, self.MD))
        diagonal: FloatArray = H.diagonal()
        self.penalty = 1.0 if norm == "shell" else self.total / float(diagonal @ ((self.J @ self.D.T) ** 2).sum(axis=1))
        self.G = self.penalty * diagonal
        eta = space.material.eta
        self.norm = WeightedNorm.of(space.reference.with_vertices(self.point.vertices), eta)
        # Σ w_l |u_l| + η Σ w_θ |u_θ|, from the squares w_l² and η w_θ².
        self.weights = np.sqrt(self.norm.squared * np.repeat([1, eta], space.connectivity.edge_count))

    def balanced(self, fields: FloatArray) -> FloatArray:
        """Fields (n, V, 3) as rows (n, 3V), with the rigid motion that makes them smallest in the norm of vertices."""
        flat, motions = fields.reshape(len(fields), -1), rigid_motions(self.point.vertices)
        lowered = motions * self.areas
        rigid: FloatArray = np.linalg.solve(lowered @ motions.T, lowered @ flat.T).T @ motions
        return flat - rigid

    def shrinkage_matrix(self) -> tuple[SymmetricPattern, FloatArray]:
        """``M + JᵀGJ``."""
        form, matrix = self.form, NormalMatrix(self.point.space.connectivity)
        faces = form.faces * (self.shell + self.penalty * np.eye(3)[:, :, None])
        scaled = QuadraticForm(faces, form.angles * (self.shell + self.penalty))
        entries = matrix.entries(self.point.gradients, scaled)
        entries[matrix.pattern.diagonal] += self.plain * self.areas
        return matrix.pattern, entries

    def principal(self, count: int) -> tuple[FloatArray, FloatArray]:
        """The strongest m modes (m, 3V), orthogonal, and coefficients (m, n), orthonormal: ``D ≈ Wᵀ modes``."""
        values, vectors = np.linalg.eigh(self.D @ self.MD)
        kept = np.flatnonzero(values > NEGLIGIBLE * self.total)[::-1][:count]
        W = vectors[:, kept].T
        return W @ self.D, W

    def scaled(self, D: FloatArray) -> FloatArray:
        """Fields (m, 3V) as lengths and angles (2E, m), in units of the metric's diagonal."""
        return np.sqrt(self.G)[:, None] * (self.J @ D.T)

    def one_norms(self, D: FloatArray) -> FloatArray:
        """``‖J d‖_1`` (m,) of fields (m, 3V)."""
        return self.weights @ np.abs(self.J @ D.T)

    def highest_price(self, D: FloatArray, W: FloatArray) -> float:
        """The largest λ at which one of these modes is worth having: where ``(1−s)² E + s λ L`` first falls with s."""
        D, W = _normalised(D, W)
        energies = (W**2).sum(axis=1) * np.einsum("jx,xj->j", D, self.M @ D.T)
        return float((2 * energies / self.one_norms(D)).max())

    def project(self, D: FloatArray) -> tuple[NDArray, float]:
        """Coefficients (m, n) of the logarithms' projections to the span of fields (m, 3V), and the share explained."""
        B = D @ self.MD
        W = np.linalg.lstsq(D @ (self.M @ D.T), B, rcond=NEGLIGIBLE)[0]
        return W, float(np.vdot(W, B)) / self.total

    def left_of_held_out(self, original_index: IntArray | None = None) -> FloatArray:
        """(n, n) squares of what 0, 1, 2 … principal modes of the other logarithms leave of those that are held out."""
        gram, n = self.D @ self.MD, len(self.D)
        original_index = np.arange(n) if original_index is None else original_index
        parts = min(INNER_FOLDS, int(original_index.max()) + 1)
        left = np.zeros((n, n))
        for held in (np.flatnonzero(original_index % parts == part) for part in range(parts)):
            kept = np.delete(np.arange(n), held)
            values, vectors = np.linalg.eigh(gram[np.ix_(kept, kept)])
            some = np.flatnonzero(values > NEGLIGIBLE * self.total)[::-1]
            along = np.zeros((len(held), n))
            along[:, 1 : 1 + len(some)] = (gram[np.ix_(held, kept)] @ vectors[:, some]) ** 2 / values[some]
            left[held] = np.maximum(gram[held, held][:, None] - np.cumsum(along, axis=1), 0)
        return left

    def modes(self, D: FloatArray, converged: bool = True, history: list[dict[str, float]] | None = None) -> Modes:
        """Project the logarithms to the span, drop what carries nothing, scale, orient and sort."""
        D = D[np.einsum("jx,xj->j", D, self.M @ D.T) > NEGLIGIBLE * self.total / len(self.D)]
        if not len(D):
            raise ModeError("the sparsity is too high: no mode is left")
        W, explained = self.project(D)
        peaks = W[np.arange(len(W)), np.abs(W).argmax(axis=1)]
        D, W = D * peaks[:, None], W / peaks[:, None]
        energies = (W**2).sum(axis=1) * np.einsum("jx,xj->j", D, self.M @ D.T)
        order = np.argsort(-energies, kind="stable")
        D, W = D[order], W[order]
        vertices = without_rigid_motion(D.reshape(len(D), -1, 3), self.point.vertices)
        return Modes(
            nric=(self.J @ vertices.reshape(len(D), -1).T).T,
            vertices=vertices,
            coefficients=W.T,
            explained=explained,
            converged=converged,
            history=history or [],
        )


def _matrix(form: QuadraticForm, sides: NDArray[np.int64], edges: int) -> sparse.csr_array:
    """A quadratic form as a matrix (2E, 2E)."""
    rows = np.broadcast_to(sides[:, None], form.faces.shape).ravel()
    columns = np.broadcast_to(sides[None], form.faces.shape).ravel()
    lengths = sparse.csr_array((form.faces.ravel(), (rows, columns)), shape=(edges, edges))
    return sparse.csr_array(sparse.block_diag([lengths, sparse.diags_array(form.angles)], format="csr"))


def _normalised(D: FloatArray, W: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same product ``Dᵀ W`` with ``|w_j|_∞ = 1``."""
    largest = np.abs(W).max(axis=1, keepdims=True)
    return D * largest, W / largest


def _varimax(loadings: FloatArray) -> FloatArray:
    """The rotation (m, m) that makes the squares of loadings (p, m) differ most (Kaiser 1958), by SVD."""
    rotation, before = np.eye(loadings.shape[1]), 0.0
    for _ in range(VARIMAX_ITERATIONS):
        turned = loadings @ rotation
        left, values, right = np.linalg.svd(loadings.T @ (turned**3 - turned * (turned**2).mean(axis=0)))
        rotation = left @ right
        if values.sum() < before * (1 + 1e-7):
            break
        before = values.sum()
    return rotation


class _SparsityCriterion:
    """Whether modes keep enough of the logarithms, beside as many principal modes (m, 3V): see SPENT."""

    def __init__(
        self,
        space: ShellSpace,
        mean: FloatArray,
        fields: FloatArray,
        D: FloatArray,
        norm: Norm,
        original_index: IntArray | None,
    ) -> None:
        self._seen = _ModeProblem(space, mean, fields, 1, _judged(norm))
        left = self._seen.left_of_held_out(original_index)[:, min(len(D), len(fields) - 1)].sum()
        self._least = self._seen.project(D)[1] - SPENT * float(left) / self._seen.total

    def __call__(self, D: FloatArray) -> bool:
        """Of modes (m, 3V)."""
        return self._seen.project(D)[1] >= self._least


class _Shrinkage:
    """ADMM for ``argmin_d ‖d − t‖_M² + p ‖J d‖_1``, with a state for each mode that is kept between calls."""

    def __init__(self, problem: _ModeProblem, space: ShellSpace, D: FloatArray) -> None:
        G = problem.G
        pattern, entries = problem.shrinkage_matrix()
        self._factor = analyse(pattern, space.backend).factorise(entries)
        self._J, self._M = problem.J, problem.M
        self._JtG = sparse.csr_array(problem.J.T @ sparse.diags_array(G))
        self._threshold = np.divide(problem.weights, 2 * G, out=np.zeros_like(G), where=G > 0)
        self._z = (self._J @ D.T).T
        self._y = np.zeros_like(self._z)

    def __call__(self, j: int, target: FloatArray, price: float) -> FloatArray:
        """Improve mode j (3V,) towards a target."""
        z, y, threshold = self._z[j], self._y[j], price * self._threshold
        pull = self._M @ target
        for _ in range(INNER_ITERATIONS):
            d = self._factor.solve(pull + self._JtG @ (z - y))
            y += OVERRELAXATION * (self._J @ d) + (1 - OVERRELAXATION) * z
            z[:] = np.sign(y) * np.maximum(np.abs(y) - threshold, 0)
            y -= z
        return d


def _alternate(
    problem: _ModeProblem, D: FloatArray, W: FloatArray, price: float, max_iterations: int, tolerance: float
) -> tuple[bool, list[dict[str, float]]]:
    """Minimise in place over modes D (m, 3V) and coefficients W (m, n), block by block; never uphill."""
    shrink = _Shrinkage(problem, problem.point.space, D)
    history: list[dict[str, float]] = []
    for iteration in range(max_iterations + 1):
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
        if iteration >= PATIENCE:
            then, now = history[-1 - PATIENCE]["objective"], history[-1]["objective"]
            if then - now <= tolerance * now:
                return True, history
        _fit_in_box(gram, B, W)
        for j, w in enumerate(W):
            square = float(w @ w)
            if square == 0:
                continue
            others = W @ w
            others[j] = 0
            target = (w @ problem.D - others @ D) / square
            lowered = problem.M @ target

            def worth(d: FloatArray) -> float:
                """The objective with this as mode j, less what it is with none."""
                fit = d @ (problem.M @ d) - 2 * d @ lowered  # noqa: B023 - used before the next round
                return float(square * fit + price * problem.one_norms(d[None])[0])  # noqa: B023

            # ADMM need not go downhill, and near the end of a mode nothing may be better than something.
            D[j] = min((shrink(j, target, price / square), D[j].copy(), np.zeros_like(target)), key=worth)
    return False, history


def _fit_in_box(gram: FloatArray, B: FloatArray, W: FloatArray) -> None:
    """Minimise ``wᵀ gram w − 2 wᵀ b`` over |w|_∞ ≤ 1 for each column of B (m, n), in place, by coordinate descent."""
    for _ in range(SWEEPS):
        before = W.copy()
        for j in np.flatnonzero(gram.diagonal()):
            W[j] = np.clip(W[j] + (B[j] - gram[j] @ W) / gram[j, j], -1, 1)
        if np.abs(W - before).max() < 1e-9:
            break
