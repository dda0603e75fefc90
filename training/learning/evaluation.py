"""Figures of a run for the paper's table: R² of every model, vertex error, sizes and times; shapes for the report."""

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
from shapespace.training.learning.baselines import ExactShapes, factor_grids
from shapespace.training.learning.composite import Composite, affine_sum
from shapespace.training.learning.layers import narrowest
from shapespace.training.learning.learner import Learner
from shapespace.training.learning.networks import predict
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.progress import progress
from shapespace.training.runs.sampling import Collection


def r_squared(predicted: NDArray, exact: NDArray, norm: WeightedNorm) -> dict[str, float]:
    """Return ``1 − Σ‖z̃_i − z_i‖² / Σ‖z_i − mean‖²`` in total, of lengths and of angles (paper, section 4).

    The mean is over these samples.
    """
    half = exact.shape[1] // 2
    exact = exact.astype(np.float64)
    error, spread = (predicted - exact) ** 2, (exact - exact.mean(axis=0)) ** 2

    def ratio(part: slice) -> float:
        weights = norm.squared[part]
        return float(1 - (error[:, part] @ weights).sum() / (spread[:, part] @ weights).sum())

    return {"total": ratio(slice(None)), "lengths": ratio(slice(0, half)), "angles": ratio(slice(half, None))}


#: Number of frames of an interpolation for the report.
STRIP_FRAMES = 7
#: Number of random shapes for the report.
RANDOM_SHOWN = 8
#: Map from codes (n, m) to NRIC of joint shapes (n, 2E), or of factor shapes (n, J, 2E).
Model = Callable[[torch.Tensor], torch.Tensor]


def reconstruct(
    reference: TriangleMesh, eta: float, predicted: NDArray, exact: NDArray
) -> tuple[FloatArray, FloatArray, dict[str, Any]]:
    """Reconstruct predicted NRIC (n, 2E), and compare with exact vertices (n, V, 3) after rigid alignment.

    Returns the aligned vertices (n, V, 3); vertex distances (n, V), as fractions of the reference's bounding-box
    diagonal; ``mean`` and ``max`` distance, mean Gauss–Newton ``iterations``, and the count of each ``status``.
    """
    reconstructor = Reconstructor(reference, eta)
    shapes = progress(predicted, "turning predictions into shapes", "shape", len(predicted))
    found = [reconstructor(z, tolerance=1e-6) for z in shapes]
    vertices = align(np.array([f.vertices for f in found]), exact)
    errors = np.linalg.norm(vertices - exact, axis=2) / reference.diagonal
    figures = {
        "mean": float(errors.mean()),
        "max": float(errors.max()),
        "iterations": float(np.mean([f.iterations for f in found])),
        "status": dict(Counter(str(f.status) for f in found)),
    }
    return vertices, errors, figures


@dataclass(frozen=True)
class HeldOutSamples:
    """Joint samples that no network is fitted to: of the validation codes, or of the test codes."""

    rows: IntArray  # (n,) rows of the joint samples
    latents: FloatArray  # (n, m) codes
    z: NDArray[np.float32]  # (n, 2E) exact NRIC
    vertices: NDArray[np.float32]  # (n, V, 3) exact vertices
    norm: WeightedNorm  # norm of NRIC differences

    @classmethod
    def of(cls, learner: Learner, name: str = "test") -> HeldOutSamples:
        """Return the samples of a part of a learner's split, by its name."""
        rows, joint = learner.split[name], learner.joint
        norm = WeightedNorm.of(learner.collection.reference, learner.config.evaluation.eta)
        return cls(rows, joint.latents[rows], joint.nric[rows], joint.vertices[rows], norm)

    def r2(self, model: Model) -> dict[str, float]:
        """Return R² of a model's prediction for all codes."""
        return self.r2_of(self.predicted(model))

    def r2_of(self, predicted: NDArray, rows: IntArray | slice = slice(None)) -> dict[str, float]:
        """Return R² of NRIC (k, 2E) predicted for these rows of the held-out samples."""
        return r_squared(predicted, self.z[rows], self.norm)

    def predicted(self, model: Model) -> NDArray[np.float32]:
        """Return a model's prediction for all codes."""
        return predict(model, torch.as_tensor(self.latents, dtype=torch.float32)).numpy()


def evaluate(learner: Learner, exact: ExactShapes) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """Compare every model with the exact shapes of the test codes. Returns the contents of evaluation.json and of
    gallery.npz.
    """
    config, collection = learner.config, learner.collection
    settings, reference = config.evaluation, collection.reference
    z_reference = nric(reference.vertices, reference.connectivity)
    test, composite = HeldOutSamples.of(learner), learner.main()
    if learner.straight:
        return _evaluate_straight(learner, test, composite)
    models: dict[str, Composite | nn.Module] = {"composite": composite}
    if settings.baselines:
        models |= {"monolithic": learner.monolithic(), "monolithic_paper": learner.monolithic_paper()}
    models["kernel"] = learner.kernel()
    if config.networks.paper:
        models["paper"] = learner.paper()
    shapes, found = exact_factors(learner, test.rows[: settings.exact_factors], exact)
    learned = test.predicted(composite.factor_shapes)
    r2 = {
        **{name: test.r2(model) for name, model in models.items()},
        "affine": test.r2_of(affine_sum(z_reference, shapes), found),
        "affine of learned factors": test.r2_of(affine_sum(z_reference, learned)),
    }
    sizes = {name: size_bytes(model) for name, model in models.items()}
    if settings.baselines and (
        grids := factor_grids(collection.coordinates, collection.factors.values(), settings, exact)
    ):
        interpolated = affine_sum(z_reference, np.stack([grid(test.latents) for grid in grids], axis=1))
        # A node without a shape leaves NaN around it.
        if np.isfinite(interpolated).all():
            r2["grid"] = test.r2_of(interpolated)
            sizes["grid"] = sum(grid.size for grid in grids)
    fresh = on_fresh_codes(models, learner, min(settings.fresh, len(test.rows)), exact)
    limit = against_limit(learner, fresh["seed"], fresh["codes"], exact) if fresh else None
    if limit:
        r2["limit"] = limit["composite"].pop("r2")
    first, eta = slice(settings.reconstructions), config.export.eta_reconstruction
    vertices, errors, vertex_error = reconstruct(reference, eta, test.predicted(composite)[first], test.vertices[first])
    figures = {
        "eta": settings.eta,
        "test_samples": len(test.rows),
        "r2": r2,
        "fresh": fresh,
        "limit": limit,
        "affine_samples": len(found),
        "r2_factors": {
            name: r_squared(learned[found, j], shapes[:, j], test.norm) for j, name in enumerate(collection.factors)
        },
        "exponentials": learner.exponentials(),
        "derivatives": len(learner.differentiated()[0]),
        "correction": {"kind": composite.combiner.settings.kind, "tried": composite.combiner.tried},
        "vertex_error": vertex_error,
        "sizes": sizes,
        "times": model_times(collection, composite, eta),
    }
    gallery = extremes(vertices, test.vertices[first], errors, test.rows[first])
    return figures, gallery | strip(collection, composite, eta) | {"faces": reference.faces}


def _evaluate_straight(
    learner: Learner, test: HeldOutSamples, composite: Composite
) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """Compare a straight-line model with the exact shapes of the test codes. Nothing else is trained beside it, and its
    one factor is its own affine sum.
    """
    config, collection = learner.config, learner.collection
    first, eta = slice(config.evaluation.reconstructions), config.export.eta_reconstruction
    predicted = test.predicted(composite)
    r2 = test.r2_of(predicted)
    vertices, errors, vertex_error = reconstruct(collection.reference, eta, predicted[first], test.vertices[first])
    figures = {
        "eta": config.evaluation.eta,
        "test_samples": len(test.rows),
        "r2": {"composite": r2, "affine": r2},
        "fresh": None,
        "correction": {"kind": composite.combiner.settings.kind, "tried": {}},
        "vertex_error": vertex_error,
        "sizes": {"composite": size_bytes(composite)},
        "times": model_times(collection, composite, eta),
    }
    gallery = extremes(vertices, test.vertices[first], errors, test.rows[first])
    return figures, gallery | strip(collection, composite, eta) | {"faces": collection.reference.faces}


#: Share of the fresh codes whose exponentials are also computed near the limit of many steps.
NEAR_LIMIT = 0.2


def on_fresh_codes(
    models: Mapping[str, Composite | nn.Module], learner: Learner, count: int, exact: ExactShapes
) -> dict[str, Any] | None:
    """Return R² of models on fresh codes, drawn with a digest of the finished composite as seed.

    No choice can have been made on these codes, since they follow from the networks.

    Returns:
        ``seed``, the first 32 bits of the digest; the SHA-256 of the ``count`` codes as doubles; the number that
        ``failed``, and R² on the others. None if fewer than two codes have a shape.
    """
    collection, coordinates = learner.collection, learner.collection.coordinates
    digest = hashlib.sha256()
    for part in learner.main().parts:
        for _, tensor in sorted(part.state_dict().items()):
            digest.update(tensor.contiguous().numpy().tobytes())
    seed = int(digest.hexdigest()[:8], 16)
    codes = coordinates.uniform(count, np.random.default_rng(seed))
    z = exact("fresh", codes).nric if count else np.empty((0, 0))
    found = np.flatnonzero(np.isfinite(z).all(axis=1))
    if len(found) < 2:
        return None
    norm = WeightedNorm.of(collection.reference, learner.config.evaluation.eta)
    latents = torch.as_tensor(codes[found], dtype=torch.float32)
    return {
        "seed": seed,
        "sha256": hashlib.sha256(codes.tobytes()).hexdigest(),
        "codes": count,
        "failed": count - len(found),
        "r2": {name: r_squared(predict(model, latents).numpy(), z[found], norm) for name, model in models.items()},
    }


def against_limit(learner: Learner, seed: int, count: int, exact: ExactShapes) -> dict[str, Any] | None:
    """Compare the composite and the exponentials of K steps with the limit of many steps, on a fifth of fresh codes.

    Arguments are the seed and number of the fresh codes. Vertex distances are fractions of the diagonal of the
    reference's bounding box, after rigid alignment.

    Returns:
        ``steps`` of the exponentials that stand for the limit; the number of ``codes`` with a shape; ``r2`` and
        ``vertices``, the ``mean`` and ``max`` distance, for ``composite`` and ``exponentials``. None where shapes have
        no time steps, or fewer than two codes have both shapes.
    """
    collection, config = learner.collection, learner.config
    if collection.limit is None:
        return None
    codes = collection.coordinates.uniform(count, np.random.default_rng(seed))
    some = codes[: max(2, round(NEAR_LIMIT * count))]
    shot, wanted = exact("fresh", codes), exact("fresh, limit", some, collection.limit)
    there = np.isfinite(shot.nric[: len(some)]).all(axis=1) & np.isfinite(wanted.nric).all(axis=1)
    rows = np.flatnonzero(there)
    if len(rows) < 2:
        return None
    norm = WeightedNorm.of(collection.reference, config.evaluation.eta)
    answers = predict(learner.main(), torch.as_tensor(some[rows], dtype=torch.float32)).numpy()
    reference = collection.reference
    ends, limit = (found.vertices[rows].astype(np.float64) for found in (shot, wanted))
    away = np.linalg.norm(align(ends, limit) - limit, axis=2) / reference.diagonal
    missed = reconstruct(reference, config.export.eta_reconstruction, answers, limit)[2]
    return {
        "steps": collection.limit.steps,
        "codes": len(rows),
        "composite": {
            "r2": r_squared(answers, wanted.nric[rows], norm),
            "vertices": {name: missed[name] for name in ("mean", "max")},
        },
        "exponentials": {
            "r2": r_squared(shot.nric[rows], wanted.nric[rows], norm),
            "vertices": {"mean": float(away.mean()), "max": float(away.max())},
        },
    }


def exact_factors(learner: Learner, rows: IntArray, exact: ExactShapes) -> tuple[NDArray[np.float32], IntArray]:
    """Return exact shapes of each factor's part of joint samples (n,).

    Returns NRIC (k, J, 2E) of the samples for which all factors have a shape, and the indices (k,) of these samples. A
    joint shape can exist where the shape of one factor does not.
    """
    count = len(learner.collection.factors)
    shapes = np.stack([_exact_factor(learner, rows, j, exact) for j in range(count)], axis=1)
    found = np.flatnonzero(np.isfinite(shapes).all(axis=(1, 2)))
    return shapes[found], found


def _exact_factor(learner: Learner, rows: IntArray, j: int, exact: ExactShapes) -> NDArray[np.float32]:
    """Return exact NRIC (n, 2E) of one factor's part of joint samples (n,), NaN where it has no shape."""
    index = list(learner.collection.factors.values())[j]
    codes, samples = learner.joint.index[rows], learner.factor_samples(j)
    result = np.full((len(rows), samples.nric.shape[1]), np.nan, dtype=np.float32)
    # A shortened sample has another code than the joint code's part.
    known = np.isin(codes, samples.index[~samples.shortened])
    result[known] = samples.nric[np.searchsorted(samples.index, codes[known])]
    beyond = codes >= learner.config.samples.own(len(learner.collection.factors))[j]
    if beyond.any():
        result[beyond] = exact(f"factor-{j}", alone(learner.joint.latents[rows[beyond]], index)).nric
    return result


def size_bytes(model: Composite | nn.Module) -> int:
    """Return the bytes of a model's large tensors in a bundle: floating-point numbers, and places of entries."""
    networks = model.parts if isinstance(model, Composite) else [model]
    every = (item for network in networks for item in network.state_dict().items())
    large = (tensor for name, tensor in every if tensor.is_floating_point() or name == "basis.place")
    return sum(tensor.numel() * narrowest(tensor).itemsize for tensor in large)


def median_seconds(function: Callable[[], Any], repeat: int = 20) -> float:
    """Return the median wall time of a call, after one call that does not count."""
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def model_times(collection: Collection, composite: Model, eta: float) -> dict[str, float]:
    """Return median seconds for one code on one thread: exact shape, composite, reconstruction from the reference.

    Where shapes have derivatives, the time of an exact shape with its derivatives as well.
    """
    latents = collection.coordinates.uniform(1, np.random.default_rng(0))
    z = collection.shapes(latents).nric[0]
    reconstructor = Reconstructor(collection.reference, eta)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            code = torch.as_tensor(latents, dtype=torch.float32)
            times = {
                "exact": median_seconds(lambda: collection.shapes(latents)),
                "networks": median_seconds(lambda: composite(code)),
                "reconstruction": median_seconds(lambda: reconstructor(z, tolerance=1e-6), repeat=5),
            }
            if differentiated := collection.differentiated:
                times["exact, with derivatives"] = median_seconds(lambda: differentiated.shapes(latents), repeat=5)
            return times
    finally:
        torch.set_num_threads(threads)


def extremes(predicted: NDArray, exact: NDArray, errors: NDArray, index: NDArray) -> dict[str, NDArray]:
    """Return the test shapes with the least, the median and the largest error next to the exact shapes, and a few more.

    Vertices (n, V, 3) are aligned to exact ones; ``errors`` (n, V) are their distances, ``index`` (n,) the samples'
    indices.
    """
    order = np.argsort(errors.mean(axis=1))
    chosen = order[[0, len(order) // 2, -1]]
    return {
        "test_index": index[chosen],
        "test_exact": exact[chosen],
        "test_predicted": predicted[chosen],
        "test_error": errors[chosen],
        # Test codes are random. These shapes show what a random code gives.
        "random": predicted[:RANDOM_SHOWN],
    }


def strip(collection: Collection, composite: Composite, eta: float) -> dict[str, NDArray]:
    """Interpolate between two codes, jointly and by each factor alone, as in the paper's figure of SCAPE.

    The reconstruction of each frame starts from the previous frame. Returns ``strip_joint`` (T, V, 3) and
    ``strip_factors`` (J, T, V, 3), aligned to the reference.
    """
    coordinates = collection.coordinates
    ends = coordinates.uniform(2, np.random.default_rng(0))
    codes = torch.as_tensor(np.linspace(ends[0], ends[1], STRIP_FRAMES), dtype=torch.float32)
    with torch.no_grad():
        factors = composite.factor_shapes(codes)
        joint = composite.combiner(factors)
    reconstruct = Reconstructor(collection.reference, eta)
    rows = [joint, *factors.transpose(0, 1)]
    shapes = np.array([_sequence(reconstruct, z.double().numpy(), collection) for z in rows])
    return {"strip_joint": shapes[0], "strip_factors": shapes[1:]}


def _sequence(reconstruct: Callable, rows: FloatArray, collection: Collection) -> FloatArray:
    reference = collection.reference
    # The first frame is reached from the reference through three intermediate shapes.
    rest = nric(reference.vertices, reference.connectivity)
    start = reference.vertices
    for share in (0.25, 0.5, 0.75):
        start = reconstruct(rest + share * (rows[0] - rest), start, tolerance=1e-4).vertices
    frames = []
    for z in rows:
        start = reconstruct(z, start, tolerance=1e-5).vertices
        frames.append(align(start, reference.vertices))
    return np.array(frames)
