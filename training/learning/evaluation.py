"""The numbers of the paper's table for one run: R² of every model, vertex error, sizes and times."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.baselines import Exact, factor_grids
from shapespace.training.learning.composite import Composite, affine_sum
from shapespace.training.learning.gallery import extremes, strip
from shapespace.training.learning.layers import narrowest
from shapespace.training.learning.learner import Learner
from shapespace.training.learning.networks import predict
from shapespace.training.runs.latent_coordinates import alone
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


#: A map from codes (n, m) to NRIC (n, 2E), or to those of the factors (n, J, 2E).
Model = Callable[[torch.Tensor], torch.Tensor]


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


@dataclass(frozen=True)
class Split:
    """Joint samples that nothing is fitted to: the validation codes, or the test codes, which are read only here.

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
    def of(cls, learner: Learner, name: str = "test") -> Split:
        """That of this seed, by its name."""
        rows, joint = learner.split[name], learner.joint
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


def evaluate(learner: Learner, exact: Exact) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """Compare every model with the test split.

    Args:
        learner: networks of the run.
        exact: exact shapes.

    Returns:
        The contents of evaluation.json and of gallery.npz.
    """
    config, collection = learner.config, learner.collection
    settings, reference = config.evaluation, collection.reference
    z_reference = nric(reference.vertices, reference.connectivity)
    test, composite = Split.of(learner), learner.main()
    baselines: dict[str, Composite | nn.Module] = {
        "monolithic": learner.monolithic(),
        "monolithic_paper": learner.monolithic_paper(),
        "kernel": learner.kernel(),
    }
    if config.networks.paper:
        baselines["paper"] = learner.paper()
    shapes, found = exact_factors(learner, test.rows[: settings.exact_factors], exact)
    learned, predicted = test.predicted(composite.factor_shapes), test.predicted(composite)
    models: dict[str, Composite | nn.Module] = {"composite": composite, **baselines}
    r2 = {
        "composite": test.r2_of(predicted),
        **{name: test.r2(model) for name, model in baselines.items()},
        "affine": test.r2_of(affine_sum(z_reference, shapes), found),
        "affine of learned factors": test.r2_of(affine_sum(z_reference, learned)),
    }
    sizes = {name: size_bytes(model) for name, model in models.items()}
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
        "fresh": on_fresh_codes(models, learner, min(settings.fresh, len(test.rows)), exact),
        "affine_samples": len(found),
        "r2_factors": {
            name: r_squared(learned[found, j], shapes[:, j], test.norm) for j, name in enumerate(collection.factors)
        },
        "exponentials": learner.exponentials(),
        "derivatives": len(learner.differentiated()[0]),
        "correction": {"kind": composite.combiner.settings.kind, "tried": composite.combiner.tried},
        "vertex_error": reconstructed.figures(),
        "sizes": sizes,
        "times": model_times(collection, composite, eta),
    }
    gallery = extremes(reconstructed.vertices, test.vertices[first], reconstructed.errors, test.rows[first])
    return figures, gallery | strip(collection, composite, eta) | {"faces": reference.faces}


#: Share of the fresh codes whose exponentials are computed once more, with twice as many steps.
FINER = 0.2


def on_fresh_codes(
    models: Mapping[str, Composite | nn.Module], learner: Learner, count: int, exact: Exact
) -> dict[str, Any] | None:
    """R² of models on codes that could not be chosen on: they follow from the digest of the first, the composite.

    Returns:
        ``seed``, the first 32 bits of that digest; the SHA-256 of the ``count`` codes as doubles; how many ``failed``,
        and R² on the others. Where exponentials are made by steps, ``steps``: R² of theirs to those with twice as many.
        None if there are fewer than two.
    """
    collection, coordinates = learner.collection, learner.collection.coordinates
    digest = hashlib.sha256()
    for part in learner.main().parts:
        for _, tensor in sorted(part.state_dict().items()):
            digest.update(tensor.contiguous().numpy().tobytes())
    seed = int(digest.hexdigest()[:8], 16)
    codes = coordinates.uniform(count, np.random.default_rng(seed))
    z = exact("fresh", codes) if count else np.empty((0, 0))
    found = np.flatnonzero(np.isfinite(z).all(axis=1))
    if len(found) < 2:
        return None
    norm = WeightedNorm.of(collection.reference, learner.config.evaluation.eta)
    latents = torch.as_tensor(codes[found], dtype=torch.float32)
    result = {
        "seed": seed,
        "sha256": hashlib.sha256(codes.tobytes()).hexdigest(),
        "codes": count,
        "failed": count - len(found),
        "r2": {name: r_squared(predict(model, latents).numpy(), z[found], norm) for name, model in models.items()},
    }
    if collection.finer:
        some = found[: max(2, round(FINER * count))]
        finer = exact("fresh, finer", codes[some], collection.finer)
        both = np.flatnonzero(np.isfinite(finer).all(axis=1))
        result["steps"] = r_squared(z[some][both], finer[both], norm) if len(both) > 1 else None
    return result


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


def size_bytes(model: Composite | nn.Module) -> int:
    """Bytes of what is large in a bundle, in the types that it has there: numbers, and the places of entries."""
    networks = model.parts if isinstance(model, Composite) else [model]
    every = (item for network in networks for item in network.state_dict().items())
    large = (tensor for name, tensor in every if tensor.is_floating_point() or name == "basis.place")
    return sum(tensor.numel() * narrowest(tensor).itemsize for tensor in large)


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
    """Median seconds for one code: exact shape, composite network, reconstruction from the reference (one thread).

    Where shapes have derivatives, those of the exact shape with these too.
    """
    rng = np.random.default_rng(0)
    latents = collection.coordinates.uniform(1, rng)
    z = collection.shapes(latents).nric[0]
    reconstruct = Reconstructor(collection.reference, eta)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            code = torch.as_tensor(latents, dtype=torch.float32)
            times = {
                "exact": median_seconds(lambda: collection.shapes(latents)),
                "networks": median_seconds(lambda: composite(code)),
                "reconstruction": median_seconds(lambda: reconstruct(z, tolerance=1e-6), repeat=5),
            }
            if differentiated := collection.differentiated:
                times["exact, with derivatives"] = median_seconds(lambda: differentiated.shapes(latents), repeat=5)
            return times
    finally:
        torch.set_num_threads(threads)
