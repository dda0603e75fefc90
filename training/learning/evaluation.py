"""The numbers of the paper's table for one run: R² of every model, vertex error, sizes and times."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from torch import nn

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.gallery import extremes, strip
from shapespace.training.learning.layers import narrowest
from shapespace.training.learning.learner import Learner
from shapespace.training.learning.networks import Composite, affine_sum, predict
from shapespace.training.runs.config import Config, EvaluationSettings
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.progress import progress
from shapespace.training.runs.sampling import Collection


def r_squared(predicted: NDArray, exact: NDArray, norm: WeightedNorm) -> dict[str, float]:
    """``1 − Σ‖z̃_i − z_i‖² / Σ‖z_i − mean‖²`` of both halves and of each (paper, section 4; mean over these samples)."""
    half = exact.shape[1] // 2
    exact = exact.astype(np.float64)
    error, spread = (predicted - exact) ** 2, (exact - exact.mean(axis=0)) ** 2

    def ratio(part: slice) -> float:
        weights = norm.squared[part]
        return float(1 - (error[:, part] @ weights).sum() / (spread[:, part] @ weights).sum())

    return {
        "total": ratio(slice(None)),
        "lengths": ratio(slice(0, half)),
        "angles": ratio(slice(half, None)),
    }


def alone(latents: FloatArray, factor: list[int]) -> FloatArray:
    """Codes (n, m) with the latents of one factor only, the others zero."""
    result = np.zeros_like(latents)
    result[:, factor] = latents[:, factor]
    return result


#: Of each coordinate of a grid: with two it would be linear.
FEWEST_NODES = 3

#: A map from codes (n, m) to NRIC (n, 2E), or to those of the factors (n, J, 2E).
Model = Callable[[torch.Tensor], torch.Tensor]

#: Exact NRIC (n, 2E) of codes (n, m), which are saved under a name; NaN for a code whose shape was not found.
Exact = Callable[[str, FloatArray], NDArray[np.float32]]


@dataclass(frozen=True)
class MultilinearGrid:
    """Multilinear interpolation of exact shapes on a regular grid of one factor (Sassen et al. 2020).

    Attributes:
        factor: indices of the factor's latents.
        interpolate: NRIC (n, 2E) of these latents (n, m_j).
        size: bytes of the values at the nodes.
    """

    factor: list[int]
    interpolate: RegularGridInterpolator
    size: int

    def __call__(self, latents: FloatArray) -> FloatArray:
        """NRIC (n, 2E) of the factor's part of codes (n, m)."""
        result: FloatArray = self.interpolate(latents[:, self.factor])
        return result

    @classmethod
    def of(
        cls, coordinates: Coordinates, factor: list[int], nodes: int, shapes: Callable[[FloatArray], NDArray]
    ) -> MultilinearGrid:
        """Evaluate the nodes exactly.

        Args:
            coordinates: of all latents.
            factor: indices of the factor's.
            nodes: number along each of them; the end of a period is its beginning and does not count.
            shapes: exact NRIC (n, 2E) of codes (n, m).
        """
        own = coordinates[factor]
        ends = np.isfinite(own.period).astype(int)
        axes = [np.linspace(a, b, nodes + end) for a, b, end in zip(own.lower, own.upper, ends, strict=True)]
        latents = np.zeros((nodes ** len(factor), len(coordinates)))
        at_nodes = np.meshgrid(*(axis[:nodes] for axis in axes), indexing="ij")
        latents[:, factor] = np.stack(at_nodes, axis=-1).reshape(-1, len(factor))
        values = shapes(latents).reshape(*[nodes] * len(factor), -1)
        closed = np.pad(values, [*((0, end) for end in ends), (0, 0)], mode="wrap")
        # Rounding may move a code to just outside of the grid.
        return cls(factor, RegularGridInterpolator(axes, closed, bounds_error=False, fill_value=None), values.nbytes)


@dataclass(frozen=True)
class Reconstructions:
    """Shapes reconstructed from predicted lengths and angles, beside the exact ones.

    Attributes:
        vertices: (n, V, 3), aligned to the exact ones.
        errors: (n, V) distances, as fractions of the reference's bounding-box diagonal.
        iterations: (n,) of Gauss–Newton from the reference.
        statuses: (n,) of the same.
    """

    vertices: FloatArray
    errors: FloatArray
    iterations: list[int]
    statuses: list[str]

    @classmethod
    def of(cls, reference: TriangleMesh, eta: float, predicted: NDArray, exact: NDArray) -> Reconstructions:
        """Reconstruct NRIC (n, 2E) and compare with vertices (n, V, 3) after rigid alignment."""
        reconstruct = Reconstructor(reference, eta)
        shapes = progress(predicted, "reconstructed shapes", "shape", len(predicted))
        found = [reconstruct(z, tolerance=1e-6) for z in shapes]
        vertices = align(np.array([f.vertices for f in found]), exact)
        errors = np.linalg.norm(vertices - exact, axis=2) / reference.diagonal
        return cls(vertices, errors, [f.iterations for f in found], [str(f.status) for f in found])

    def figures(self) -> dict[str, Any]:
        """``mean`` and ``max`` error, mean ``iterations``, and the number of times of each ``status``."""
        return {
            "mean": float(self.errors.mean()),
            "max": float(self.errors.max()),
            "iterations": float(np.mean(self.iterations)),
            "status": dict(Counter(self.statuses)),
        }


def grid_nodes(dimension: int, settings: EvaluationSettings) -> int:
    """Nodes along each coordinate of a factor's grid; where these are less than FEWEST_NODES there is none."""
    return min(settings.grid_nodes, int(settings.grid_size ** (1 / dimension) + 1e-9))


@dataclass(frozen=True)
class TestSplit:
    """The test split of a learner, which is read here and nowhere before.

    Attributes:
        rows: (n,) of the joint samples.
        latents: (n, m) codes.
        z: (n, 2E) exact NRIC.
        vertices: (n, V, 3) exact ones.
        norm: of differences of NRIC.
    """

    rows: IntArray
    latents: FloatArray
    z: NDArray[np.float32]
    vertices: NDArray[np.float32]
    norm: WeightedNorm

    @classmethod
    def of(cls, learner: Learner) -> TestSplit:
        """That of this seed."""
        rows, joint = learner.split["test"], learner.joint
        norm = WeightedNorm.of(learner.collection.reference, learner.config.evaluation.eta)
        return cls(rows, joint.latents[rows], joint.nric[rows], joint.vertices[rows], norm)

    def r2(self, model: Model) -> dict[str, float]:
        """R² of what a model makes of all codes."""
        return self.r2_of(self.predicted(model))

    def r2_of(self, predicted: NDArray, rows: IntArray | slice = slice(None)) -> dict[str, float]:
        """R² of NRIC (k, 2E) that were predicted for these rows of the split."""
        return r_squared(predicted, self.z[rows], self.norm)

    def predicted(self, model: Model) -> NDArray[np.float32]:
        """What a model makes of all codes."""
        result: NDArray[np.float32] = predict(model, torch.as_tensor(self.latents, dtype=torch.float32)).numpy()
        return result


def evaluate(
    learner: Callable[..., Learner], config: Config, exact: Exact
) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """Compare every model with the test split.

    Args:
        learner: by the ``fraction`` of the training samples that it learns from, or another ``seed``.
        config: of the run.
        exact: exact shapes.

    Returns:
        The contents of evaluation.json and of gallery.npz.
    """
    settings, main = config.evaluation, learner()
    collection, reference = main.collection, main.collection.reference
    z_reference = nric(reference.vertices, reference.connectivity)
    test, composite = TestSplit.of(main), main.main()
    baselines: dict[str, Composite | nn.Module] = {
        "monolithic": main.monolithic(),
        "monolithic_paper": main.monolithic_paper(),
        "kernel": main.kernel(),
    }
    if config.networks.paper:
        baselines["paper"] = main.paper()
    shapes, found = exact_factors(main, test.rows[: settings.exact_factors], exact)
    learned, predicted = test.predicted(composite.factor_shapes), test.predicted(composite)
    r2 = {
        "composite": test.r2_of(predicted),
        **{name: test.r2(model) for name, model in baselines.items()},
        "affine": test.r2_of(affine_sum(z_reference, shapes), found),
        "affine of learned factors": test.r2_of(affine_sum(z_reference, learned)),
    }
    sizes = {name: size_bytes(model) for name, model in {"composite": composite, **baselines}.items()}
    if grids := factor_grids(collection, settings, exact):
        interpolated = affine_sum(z_reference, np.stack([grid(test.latents) for grid in grids], axis=1))
        # A node without a shape leaves NaN around it.
        if np.isfinite(interpolated).all():
            r2["grid"] = test.r2_of(interpolated)
            sizes["grid"] = sum(grid.size for grid in grids)
    first, eta = slice(settings.reconstructions), config.export.eta_reconstruction
    reconstructed = Reconstructions.of(reference, eta, predicted[first], test.vertices[first])
    figures = {
        "eta": settings.eta,
        "test_samples": len(test.rows),
        "r2": r2,
        "affine_samples": len(found),
        "r2_factors": {
            name: r_squared(learned[found, j], shapes[:, j], test.norm) for j, name in enumerate(collection.factors)
        },
        "variants": {
            name: {"title": config.variants[name].title, "r2": test.r2(variant)}
            for name, variant in main.variants().items()
        },
        "exponentials": main.exponentials(),
        "correction": {"kind": composite.combiner.settings.kind, "tried": composite.combiner.tried},
        "fractions": [_fraction(learner, fraction, test) for fraction in config.networks.fractions],
        "seeds": [_other_seed(learner(seed=seed)) for seed in config.networks.seeds],
        "vertex_error": reconstructed.figures(),
        "sizes": sizes,
        "times": model_times(collection, composite, eta),
    }
    gallery = extremes(reconstructed.vertices, test.vertices[first], reconstructed.errors, test.rows[first])
    return figures, gallery | strip(collection, composite, eta) | {"faces": reference.faces}


def _fraction(learner: Callable[..., Learner], fraction: float, test: TestSplit) -> dict[str, Any]:
    """R² of networks that learn from a fraction of the training codes, and of one with all samples of the factors."""
    some, free = learner(fraction=fraction), learner(fraction=fraction, all_of_factors=True)
    return {
        "fraction": fraction,
        "training_samples": len(some.rows["train"]),
        "exponentials": {"composite": some.exponentials(), "all of factors": free.exponentials()},
        "r2": {
            "composite": test.r2(some.main()),
            "all of factors": test.r2(free.main()),
            "monolithic": test.r2(some.monolithic()),
            "kernel": test.r2(some.kernel()),
        },
    }


def _other_seed(learner: Learner) -> dict[str, Any]:
    """R² of networks learned with another seed, on the test split of that seed."""
    test = TestSplit.of(learner)
    r2 = {"composite": test.r2(learner.main()), "monolithic": test.r2(learner.monolithic())}
    r2["kernel"] = test.r2(learner.kernel())
    return {"seed": learner.seed, "r2": r2}


def exact_factors(learner: Learner, rows: IntArray, exact: Exact) -> tuple[NDArray[np.float32], IntArray]:
    """Exact shapes of each factor's part alone of joint samples (n,).

    Returns:
        NRIC (k, J, 2E) of those samples for which all factors have one, and which these are (k,): a joint shape can
        exist where one of a factor does not.
    """
    count = len(learner.collection.factors)
    shapes = np.stack([_exact_factor(learner, rows, j, exact) for j in range(count)], axis=1)
    found = np.flatnonzero(np.isfinite(shapes).all(axis=(1, 2)))
    return shapes[found], found


def _exact_factor(learner: Learner, rows: IntArray, j: int, exact: Exact) -> NDArray[np.float32]:
    """Exact NRIC (n, 2E) of one factor's part alone of joint samples (n,), NaN where there is none."""
    index = list(learner.collection.factors.values())[j]
    codes, samples = learner.joint.index[rows], learner.factor_samples(j)
    result = np.full((len(rows), samples.nric.shape[1]), np.nan, dtype=np.float32)
    # Where a sample's code was shortened, its shape is not that of the joint code's part.
    known = np.isin(codes, samples.index[~samples.shortened])
    result[known] = samples.nric[np.searchsorted(samples.index, codes[known])]
    beyond = codes >= learner.config.samples.own(len(learner.collection.factors))[j]
    if beyond.any():
        result[beyond] = exact(f"factor-{j}", alone(learner.joint.latents[rows[beyond]], index))
    return result


def factor_grids(collection: Collection, settings: EvaluationSettings, exact: Exact) -> list[MultilinearGrid]:
    """A grid for each factor; none at all where one of them would be too coarse."""
    factors = list(collection.factors.values())
    nodes = [grid_nodes(len(index), settings) for index in factors]
    if min(nodes) < FEWEST_NODES:
        return []
    return [
        MultilinearGrid.of(collection.coordinates, index, count, partial(exact, f"grid-{j}"))
        for j, (index, count) in enumerate(zip(factors, nodes, strict=True))
    ]


def size_bytes(model: Composite | nn.Module) -> int:
    """Bytes of the floating-point parameters and buffers, in the types that they have in a bundle."""
    networks = model.parts if isinstance(model, Composite) else [model]
    tensors = (t for n in networks for t in n.state_dict().values() if t.is_floating_point())
    return sum(t.numel() * narrowest(t).itemsize for t in tensors)


def median_seconds(function: Callable[[], Any], repeat: int = 20) -> float:
    """Median wall time of a call, after one that does not count."""
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def model_times(collection: Collection, composite: Model, eta: float) -> dict[str, float]:
    """Median seconds for one code: exact shape, composite network, reconstruction from the reference (one thread)."""
    rng = np.random.default_rng(0)
    latents = collection.coordinates.uniform(1, rng)
    z = collection.shapes(latents).nric[0]
    reconstruct = Reconstructor(collection.reference, eta)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            code = torch.as_tensor(latents, dtype=torch.float32)
            return {
                "exact": median_seconds(lambda: collection.shapes(latents)),
                "networks": median_seconds(lambda: composite(code)),
                "reconstruction": median_seconds(lambda: reconstruct(z, tolerance=1e-6), repeat=5),
            }
    finally:
        torch.set_num_threads(threads)
