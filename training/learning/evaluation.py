"""The figures of the paper's table for one run: R² of every model, vertex error, sizes and times."""

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
from shapespace.training.learning.learning import Learner
from shapespace.training.learning.networks import affine_sum, predict
from shapespace.training.runs.config import Config, EvaluationSettings
from shapespace.training.runs.coordinates import Coordinates
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
    """Codes (n, m) of one factor's part alone, the rest at the reference."""
    result = np.zeros_like(latents)
    result[:, factor] = latents[:, factor]
    return result


#: A coarser grid isn't worth its exponentials.
FEWEST_NODES = 3


@dataclass(frozen=True)
class MultilinearGrid:
    """Multilinear interpolation of exact shapes on a regular grid of one factor (Sassen et al. 2020).

    Attributes:
        interpolate: NRIC (n, 2E) of the factor's latents (n, m_j).
        size: bytes of the values at the nodes.
    """

    interpolate: RegularGridInterpolator
    size: int

    @classmethod
    def of(
        cls, coordinates: Coordinates, factor: list[int], nodes: int, shapes: Callable[[FloatArray], NDArray]
    ) -> MultilinearGrid:
        """Evaluate the nodes exactly.

        Args:
            coordinates: of all latents.
            factor: indices of its own.
            nodes: of each of its coordinates; the end of a period, which is its beginning, is none.
            shapes: exact NRIC of codes (n, m).
        """
        own = coordinates[factor]
        ends = np.isfinite(own.period).astype(int)
        axes = [np.linspace(a, b, nodes + end) for a, b, end in zip(own.lower, own.upper, ends, strict=True)]
        latents = np.zeros((nodes ** len(factor), len(coordinates)))
        at_nodes = np.meshgrid(*(axis[:nodes] for axis in axes), indexing="ij")
        latents[:, factor] = np.stack(at_nodes, axis=-1).reshape(-1, len(factor))
        values = shapes(latents).reshape(*[nodes] * len(factor), -1)
        closed = np.pad(values, [*((0, end) for end in ends), (0, 0)], mode="wrap")
        # Rounding may leave a code a little outside.
        return cls(RegularGridInterpolator(axes, closed, bounds_error=False, fill_value=None), values.nbytes)


@dataclass(frozen=True)
class Reconstructions:
    """Shapes reconstructed from predicted lengths and angles, beside the exact ones.

    Attributes:
        vertices: (n, V, 3), aligned to the exact ones.
        errors: (n, V) distances, as fractions of the reference's bounding-box diagonal.
        iterations: (n,) of Gauss–Newton from the reference.
        statuses: (n,) how it ended.
    """

    vertices: FloatArray
    errors: FloatArray
    iterations: list[int]
    statuses: list[str]

    @classmethod
    def of(cls, reference: TriangleMesh, eta: float, predicted: NDArray, exact: NDArray) -> Reconstructions:
        """Reconstruct NRIC (n, 2E) and compare with vertices (n, V, 3) after rigid alignment."""
        reconstruct = Reconstructor(reference, eta)
        found = [reconstruct(z, tolerance=1e-6) for z in predicted]
        vertices = align(np.array([f.vertices for f in found]), exact)
        errors = np.linalg.norm(vertices - exact, axis=2) / reference.diagonal
        return cls(vertices, errors, [f.iterations for f in found], [str(f.status) for f in found])

    def figures(self) -> dict[str, Any]:
        """``mean`` and ``max`` error, mean ``iterations``, how often each ``status`` was met."""
        return {
            "mean": float(self.errors.mean()),
            "max": float(self.errors.max()),
            "iterations": float(np.mean(self.iterations)),
            "status": dict(Counter(self.statuses)),
        }


def grid_nodes(dimension: int, settings: EvaluationSettings) -> int:
    """Nodes of each coordinate of a factor's grid; below FEWEST_NODES there is none."""
    return min(settings.grid_nodes, int(settings.grid_size ** (1 / dimension) + 1e-9))


def evaluate(
    learner: Callable[..., Learner], config: Config, exact: Callable[[str, FloatArray], NDArray[np.float32]]
) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """Every model on the test split, which is read here and nowhere before.

    Args:
        learner: by the ``fraction`` of the training samples that it learns from, or another ``seed``.
        config: of the run.
        exact: NRIC (n, 2E) of a named set of codes (n, m), with NaN for a code whose shape couldn't be found.

    Returns:
        What goes into evaluation.json and into gallery.npz.
    """
    settings, whole = config.evaluation, learner()
    collection, reference = whole.collection, whole.collection.reference
    factors, coordinates = collection.factors, collection.coordinates
    norm = WeightedNorm.of(reference, settings.eta)
    z_reference = nric(reference.vertices, reference.connectivity)
    composite, monolithic, test = whole.main(), whole.monolithic(), whole.split["test"]

    some = test[: settings.exact_factors]
    shapes = np.stack([_exact_factor(whole, some, j, exact) for j in range(len(factors))], axis=1)
    # A joint shape can be found where a factor's own can't.
    there = np.flatnonzero(np.isfinite(shapes).all(axis=(1, 2)))
    shapes = shapes[there]
    latents, z, vertices = (getattr(whole.joint, name)[test] for name in ("latents", "nric", "vertices"))
    codes = torch.as_tensor(latents, dtype=torch.float32)

    def score(predicted: NDArray, rows: IntArray | slice = slice(None)) -> dict[str, float]:
        return r_squared(predicted, z[rows], norm)

    def network_score(network: Callable[[torch.Tensor], torch.Tensor]) -> dict[str, float]:
        return score(predict(network, codes).numpy())

    learned, answer = predict(composite.factor_shapes, codes).numpy(), predict(composite, codes).numpy()
    r2 = {
        "composite": score(answer),
        "monolithic": network_score(monolithic),
        "affine": score(affine_sum(z_reference, shapes), there),
        "affine of learned factors": score(affine_sum(z_reference, learned)),
    }
    sizes = {"composite": size_bytes(*composite.networks, composite.combiner), "monolithic": size_bytes(monolithic)}
    nodes = [grid_nodes(len(index), settings) for index in factors.values()]
    if min(nodes) >= FEWEST_NODES:
        grids = [
            MultilinearGrid.of(coordinates, index, n, partial(exact, f"grid-{j}"))
            for j, (index, n) in enumerate(zip(factors.values(), nodes, strict=True))
        ]
        values = [grid.interpolate(latents[:, index]) for grid, index in zip(grids, factors.values(), strict=True)]
        if np.isfinite(values).all():
            r2["grid"] = score(affine_sum(z_reference, np.stack(values, axis=1)))
            sizes["grid"] = sum(grid.size for grid in grids)
    first = slice(settings.reconstructions)
    eta = config.export.eta_reconstruction
    found = Reconstructions.of(reference, eta, answer[first], vertices[first])
    figures = {
        "eta": settings.eta,
        "test_samples": len(test),
        "r2": r2,
        "affine_samples": len(there),
        "r2_factors": {name: r_squared(learned[there, j], shapes[:, j], norm) for j, name in enumerate(factors)},
        "variants": {
            name: {"title": config.variants[name].title, "r2": network_score(variant)}
            for name, variant in whole.variants().items()
        },
        "exponentials": whole.exponentials(),
        "fractions": [
            {
                "fraction": fraction,
                "training_samples": len(some.rows["train"]),
                "exponentials": {"composite": some.exponentials(), "all of factors": free.exponentials()},
                "r2": {
                    "composite": network_score(some.main()),
                    "all of factors": network_score(free.main()),
                    "monolithic": network_score(some.monolithic()),
                },
            }
            for fraction, some, free in (
                (f, learner(fraction=f), learner(fraction=f, all_of_factors=True)) for f in config.networks.fractions
            )
        ],
        "seeds": [_other_seed(learner(seed=seed), norm) for seed in config.networks.seeds],
        "vertex_error": found.figures(),
        "sizes": sizes,
        "times": model_times(collection, composite, eta),
    }
    gallery = extremes(found.vertices, vertices[first], found.errors, test[first])
    return figures, gallery | strip(collection, composite, eta) | {"faces": reference.faces}


def _other_seed(learner: Learner, norm: WeightedNorm) -> dict[str, Any]:
    """R² of networks learned with another seed, on that seed's own test split."""
    test = learner.split["test"]
    codes, z = torch.as_tensor(learner.joint.latents[test], dtype=torch.float32), learner.joint.nric[test]
    models: dict[str, Callable[[torch.Tensor], torch.Tensor]]
    models = {"composite": learner.main(), "monolithic": learner.monolithic()}
    r2 = {name: r_squared(predict(model, codes).numpy(), z, norm) for name, model in models.items()}
    return {"seed": learner.seed, "r2": r2}


def _exact_factor(
    learner: Learner, test: IntArray, j: int, exact: Callable[[str, FloatArray], NDArray]
) -> NDArray[np.float32]:
    """Exact shapes (n, 2E) of a factor's part alone of joint samples (n,), NaN where there is none."""
    index = list(learner.collection.factors.values())[j]
    codes, samples = learner.joint.index[test], learner.factor_samples(j)
    result = np.full((len(test), samples.nric.shape[1]), np.nan, dtype=np.float32)
    # A part whose own shape is that of a shorter one says nothing of the joint code.
    there = np.isin(codes, samples.index[~samples.shortened])
    result[there] = samples.nric[np.searchsorted(samples.index, codes[there])]
    beyond = codes >= learner.config.samples.own(len(learner.collection.factors))[j]
    if beyond.any():
        result[beyond] = exact(f"factor-{j}", alone(learner.joint.latents[test[beyond]], index))
    return result


def size_bytes(*networks: nn.Module) -> int:
    """Bytes of the floating-point parameters and buffers, as a bundle has them."""
    tensors = (t for n in networks for t in n.state_dict().values() if t.is_floating_point())
    return sum(t.numel() * narrowest(t).itemsize for t in tensors)


def median_seconds(function: Callable[[], Any], repeat: int = 20) -> float:
    """Median wall time of a call, after one that warms up."""
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def model_times(
    collection: Collection, composite: Callable[[torch.Tensor], torch.Tensor], eta: float
) -> dict[str, float]:
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
