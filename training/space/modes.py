"""Principal geodesic analysis (PGA): the directions in which the shapes of a collection differ.

The discrete logarithm takes each shape z^i to the tangent space at the mean z̄, ``v^i = log_z̄ z^i``. The analysis finds
a few modes u_j whose combinations come close to these logarithms (paper, section 3). All computations use vertex fields
d (V, 3). With ``J = Dz(X̄)``, a field changes lengths and angles by ``u = J d``, so u is tangent for every d. One sparse
matrix M gives the norm of the misfit, ``‖u‖² = dᵀ M d``:

- "vertices": M holds the areas of the vertices, and d is the smallest motion with these changes. This norm measures the
  direction of a limb, as users see it, and gives creases little weight. Exponentials of sparse modes then soon collapse
  a face.
- "shell", as in the paper: the metric, ``M = ½ Jᵀ Hess₂W[z̄, z̄] J``. This norm gives wrinkles much weight, and the
  direction of a limb very little.
- "mixed": the first plus a tenth of the second, scaled so that the logarithms weigh the same in both.

The logarithms are not centred again. At the Riemannian centre of mass their sum is zero, and at the centred mean it is
nearly zero.

`sparse_modes` finds modes that each move a small part of the surface.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.coordinates.normal_matrix import QuadraticForm
from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.rigid_motion import rigid_motions, without_rigid_motion
from shapespace.mesh.triangle_mesh import vertex_areas
from shapespace.shell.space import ShellPoint, ShellSpace
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.local_fields import LOCAL_SHARE, LocalVariation, local_fields, scale_of
from shapespace.training.space.related import Related

#: The norm of the misfit between modes and logarithms.
Norm = Literal["mixed", "vertices", "shell"]
#: In the mixed norm: square norm of the logarithms in the shell's metric, as a share of that in the norm of vertices.
SHELL_SHARE = 0.1
#: Modes with a smaller share of the total energy are dropped, because they are round-off.
NEGLIGIBLE = 1e-9
#: The localisation of a mode is the share of the edges that carries this part of its square norm.
LOCALISED_PART = 0.95
#: Fewest shapes that can be held out: without one of them, two others still show a direction.
FEWEST = 3
#: A further mode has to lower the mean error of held-out logarithms by this share of their mean length.
WORTH = 0.005


class ModeError(ValueError):
    """Modes that can't be computed as asked, with a sentence that says why."""


@dataclass(frozen=True)
class Modes:
    """Directions in the tangent space at a mean, strongest first, and the coefficients of the shapes.

    Each mode is scaled so that the largest coefficient of a shape is 1, and positive. There may be fewer modes than
    asked for, because a mode that carries nothing is left out.
    """

    nric: FloatArray  # (m, 2E) changes u_j of lengths and angles
    vertices: FloatArray  # (m, V, 3) vertex fields d_j, without rigid motion, u_j = J d_j
    coefficients: FloatArray  # (n, m) orthogonal projections, in the norm, of the shapes' logarithms
    explained: float  # share of ``Σ ‖v^i‖²`` that the projections keep
    converged: bool = True  # whether the iteration converged
    sparsity: float = 0.0  # λ, see ``spga``
    spread: FloatArray | None = None  # (m,) standard deviations of coefficients by local fields, if there are any
    # one row for each iteration of the sparse analysis: ``iteration, objective, misfit, penalty`` (objective = misfit +
    # penalty, as shares of ``Σ ‖v^i‖²``) and ``support``, the mean of ``localisation``
    history: list[dict[str, float]] = field(default_factory=list, repr=False)

    def __len__(self) -> int:
        return len(self.vertices)


def pga(space: ShellSpace, mean: FloatArray, fields: FloatArray, count: int, norm: Norm = "mixed") -> Modes:
    """Find at most ``count`` modes whose span comes closest to logarithms (n, V, 3) at a mean (V, 3), in a norm. Raises
    ModeError if the count, at most n, is not possible, or all fields are zero.
    """
    problem = ModeProblem(space, mean, fields, count, norm)
    return problem.modes(problem.principal(count)[0])


@dataclass(frozen=True, eq=False)
class ModeCount:
    """The number of modes, and the local variation that some of them come from."""

    count: int
    supported: int  # number without local variation
    local: LocalVariation | None = None


def mode_count(
    settings: ModeSettings,
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    related: Related | None = None,
) -> ModeCount:
    """Return the number of modes, as configured and less than n, or by cross-validation with `worthwhile`.

    The error is the distance between held-out logarithms and the span of principal modes of the other shapes. No
    exponentials are computed.

    Logarithms are (n, V, 3) at X̄ (V, 3); only ``count`` and ``norm`` of the settings matter. Shapes that are
    ``related`` are held out together; by default none are. Raises ModeError if the fields can't be used.
    """
    if settings.count != "auto":
        count = max(1, min(settings.count, len(fields) - 1))
        return ModeCount(count, count)
    problem = ModeProblem(space, mean, fields, 1, validation_norm(settings.norm))
    if settings.norm == "shell":  # the paper's
        related = related or Related.none(len(fields))
        count = worthwhile(left_of_held_out(problem.D @ problem.MD, related), related.most_modes)
        return ModeCount(count, count)

    def local() -> FloatArray:
        return local_fields(space.reference.with_vertices(mean), fields)

    return worthwhile_with_local(problem.D, local, related, np.sqrt(problem.areas))


def worthwhile_with_local(
    rows: FloatArray,
    local: Callable[[], FloatArray],
    related: Related | None = None,
    root: FloatArray | float = 1.0,
) -> ModeCount:
    """Return the number of modes that pay for motions (n, 3V) of vertices, from their mean to shapes.

    Where more modes pay than n shapes have, there are further modes from ``local`` fields (n, k, V, 3). Their variance
    is `LOCAL_SHARE` of what held-out shapes have outside the span of the other shapes. ``root`` are square roots (3V,)
    of weights.
    """
    rows = rows * root
    n = len(rows)
    related = related or Related.none(n)
    left = left_of_held_out(rows @ rows.T, related)
    count = worthwhile(left, related.most_modes)
    if count < related.most_modes or related.groups < FEWEST:
        return ModeCount(count, count)
    unseen = unseen_share(left, related)
    share = LOCAL_SHARE * unseen
    if share < NEGLIGIBLE:
        return ModeCount(count, count)
    more = count_with_local(rows, local(), share, related, root)
    # As long as there are modes of the data, these are better.
    return ModeCount(more, count, LocalVariation(share, unseen)) if more >= n else ModeCount(count, count)


def count_with_local(
    rows: FloatArray, local: FloatArray, share: float, related: Related, root: FloatArray | float = 1.0
) -> int:
    """Return the number of modes that pay for rows (n, 3V), where local fields (n, k, V, 3) add a share of variance.

    ``root`` are square roots (3V,) of weights that the rows have, and the fields have not.
    """
    flat = local.reshape(-1, rows.shape[1]) * root
    every = np.concatenate([rows, scale_of(flat, rows, share) * flat])
    left = left_of_held_out(every @ every.T, related.with_local(local))[: len(rows)]
    return worthwhile(left, len(every) - 1)


def unseen_share(left: FloatArray, related: Related) -> float:
    """Return the share of the variance that held-out shapes have outside the span of the others, from square errors."""
    return float(left[:, related.most_modes].sum() / left[:, 0].sum())


def worthwhile(left: FloatArray, most: int) -> int:
    """Return the number of modes that pay, from square errors (n, q) of held-out shapes for 0, 1, 2 … modes.

    The choice m, at most ``most``, minimises ``error(m) + WORTH · m``, where the error is a share of the shapes'
    distance from the mean.
    """
    errors = np.sqrt(left)[:, : 1 + most].mean(axis=0)
    return max(1, int(np.argmin(errors + WORTH * errors[0] * np.arange(len(errors)))))


def left_of_held_out(gram: FloatArray, related: Related) -> FloatArray:
    """Return square errors (n, n) of held-out vectors for 0, 1, 2 … principal modes of the other vectors.

    ``gram`` (n, n) has the inner products of the vectors. All are taken from the mean of the other vectors. Rows of
    local fields are 0.
    """
    n = len(gram)
    left = np.zeros((n, n))
    for held, kept in related.inner_folds():
        about = related.about_mean_of(kept, related.about_mean_of(kept, gram).T)
        values, vectors = np.linalg.eigh(about[np.ix_(kept, kept)])
        some = np.flatnonzero(values > NEGLIGIBLE * gram.trace())[::-1]
        along = np.zeros((len(held), n))
        along[:, 1 : 1 + len(some)] = (about[np.ix_(held, kept)] @ vectors[:, some]) ** 2 / values[some]
        left[held] = np.maximum(about[held, held][:, None] - np.cumsum(along, axis=1), 0)
    return left


def validation_norm(norm: Norm) -> Norm:
    """Return the norm for errors of held-out shapes: vertices for "mixed", whose shell part only smooths modes."""
    return "shell" if norm == "shell" else "vertices"


def coefficients(
    space: ShellSpace, mean: FloatArray, fields: FloatArray, modes: FloatArray, norm: Norm
) -> tuple[FloatArray, float]:
    """Project logarithms (n, V, 3) orthogonally onto the span of modes (m, V, 3), at a mean (V, 3).

    Returns coefficients (n, m), and the share of ``Σ ‖v^i‖²`` that the projections keep. Raises ModeError if the
    logarithms can't be used.
    """
    problem = ModeProblem(space, mean, fields, 1, norm)
    W, explained = problem.project(problem.balanced(modes))
    return W.T, explained


def edge_magnitudes(nric: FloatArray, norm: WeightedNorm) -> FloatArray:
    """Return each edge's part (…, E) of changes (…, 2E) of lengths and angles, in a weighted norm."""
    lengths, angles = np.split(nric**2 * norm.squared, 2, axis=-1)
    return np.sqrt(lengths + angles)


def localisation(nric: FloatArray, norm: WeightedNorm) -> FloatArray:
    """Return the smallest share (m,) of the edges that carries `LOCALISED_PART` of ``‖u_j‖²``, of modes (m, 2E)."""
    squares = np.sort(edge_magnitudes(nric, norm) ** 2, axis=1)[:, ::-1].cumsum(axis=1)
    return ((squares < LOCALISED_PART * squares[:, -1:]).sum(axis=1) + 1) / squares.shape[1]


class ModeProblem:
    """The tangent space at a mean with the logarithms in it, all as matrices on flat vertex fields (3V,)."""

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
        self.H = space.energy.matrix(self.form)  # (2E, 2E) the metric on lengths and angles
        areas = vertex_areas(self.point.vertices, space.connectivity.faces)
        self.areas = np.repeat(areas / areas.mean(), 3)  # (3V,) vertex areas, 1 on average
        self.D = self.balanced(fields)  # (n, 3V) the logarithms
        plain, metric = sparse.diags_array(self.areas), self.J.T @ self.H @ self.J
        moved, strained = (float(np.vdot(self.D.T, matrix @ self.D.T)) for matrix in (plain, metric))
        if not strained > 0:
            raise ModeError("there are no modes: all shapes are the same as the mean")
        # Weights of the norm of vertices and of the shell's metric.
        self.plain = float(norm != "shell")
        self.shell = {"mixed": SHELL_SHARE * moved / strained, "vertices": 0.0, "shell": 1.0}[norm]
        self.M = sparse.csr_array(self.plain * plain + self.shell * metric)  # (3V, 3V) the norm
        self.MD = self.M @ self.D.T
        self.total = float(np.vdot(self.D.T, self.MD))  # ``Σ ‖v^i‖²``

    def balanced(self, fields: FloatArray) -> FloatArray:
        """Return fields (n, V, 3) as rows (n, 3V), each with the rigid motion that minimises the norm of vertices."""
        flat, motions = fields.reshape(len(fields), -1), rigid_motions(self.point.vertices)
        lowered = motions * self.areas
        rigid: FloatArray = np.linalg.solve(lowered @ motions.T, lowered @ flat.T).T @ motions
        return flat - rigid

    def principal(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the strongest m modes (m, 3V), orthogonal, and orthonormal coefficients (m, n): ``D ≈ Wᵀ modes``."""
        values, vectors = np.linalg.eigh(self.D @ self.MD)
        kept = np.flatnonzero(values > NEGLIGIBLE * self.total)[::-1][:count]
        W = vectors[:, kept].T
        return W @ self.D, W

    def energies(self, D: FloatArray, W: FloatArray) -> FloatArray:
        """Return ``|w_j|² ‖u_j‖²`` (m,) of fields (m, 3V) with coefficients (m, n)."""
        return (W**2).sum(axis=1) * self.squares(D)

    def squares(self, D: FloatArray) -> FloatArray:
        """Return ``‖u_j‖²`` (m,) of fields (m, 3V)."""
        return np.einsum("jx,xj->j", D, self.M @ D.T)

    def project(self, D: FloatArray) -> tuple[NDArray, float]:
        """Project the logarithms onto fields (m, 3V). Return coefficients (m, n) and the share explained."""
        B = D @ self.MD
        W = np.linalg.lstsq(D @ (self.M @ D.T), B, rcond=NEGLIGIBLE)[0]
        return W, float(np.vdot(W, B)) / self.total

    def modes(self, D: FloatArray, converged: bool = True, history: list[dict[str, float]] | None = None) -> Modes:
        """Project the logarithms onto the span of fields (m, 3V); drop negligible modes; scale, orient and sort."""
        D = D[self.squares(D) > NEGLIGIBLE * self.total / len(self.D)]
        if not len(D):
            raise ModeError("the sparsity is too high: no mode is left")
        W, explained = self.project(D)
        peaks = W[np.arange(len(W)), np.abs(W).argmax(axis=1)]
        D, W = D * peaks[:, None], W / peaks[:, None]
        order = np.argsort(-self.energies(D, W), kind="stable")
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
