"""Shapes for the report: test shapes with the least, median and largest error; an interpolation by factors."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import nric
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.training.learning.composite import Composite
from shapespace.training.runs.sampling import Collection

STRIP_FRAMES = 7


def extremes(predicted: NDArray, exact: NDArray, errors: NDArray, index: NDArray) -> dict[str, NDArray]:
    """Return the test shapes with the least, the median and the largest error next to the exact shapes.

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
    }


def strip(collection: Collection, composite: Composite, eta: float) -> dict[str, NDArray]:
    """Interpolate between two codes, jointly and by each factor alone, as in the paper's figure of SCAPE.

    The reconstruction of each frame starts from the previous frame.

    Returns:
        ``strip_joint`` (T, V, 3) and ``strip_factors`` (J, T, V, 3), aligned to the reference.
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
