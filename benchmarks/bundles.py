"""Bundles on disk, random codes of their models, and a reference that makes times on machines comparable."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm
from shapespace.model.latent_space import Codes
from shapespace.model.shape_model import ShapeModel


def bundles(folder: Path) -> list[Path]:
    """Return the folders of bundles, sorted by name and version."""
    found = (path.parent for path in folder.glob("*/*/manifest.json"))
    return sorted(found, key=lambda path: (path.parent.name, int(path.name)))


def draw(model: ShapeModel, count: int, spread: float = 1.0) -> Codes:
    """Draw random codes (count, m) in a box ``spread`` times as wide as the bounds."""
    centre = (model.latents.lower + model.latents.upper) / 2
    radius = spread * (model.latents.upper - model.latents.lower) / 2
    codes = centre + radius * np.random.default_rng(0).uniform(-1, 1, (count, len(centre)))
    return model.latents.codes(codes.tolist())[0]


def normal_matrix(model: ShapeModel, vertices: FloatArray) -> sparse.csr_array:
    """Return ``JᵀWJ`` at a normalised shape."""
    weights = WeightedNorm.of(model.reference, model.manifest.eta_reconstruction).squared
    jacobian = NRICJacobian(model.reference.connectivity)(vertices)
    return sparse.csr_array(jacobian.T @ sparse.diags_array(weights) @ jacobian)


def superlu(matrix: sparse.sparray) -> Callable[[], object]:
    """Return a call that factorises JᵀWJ plus a small multiple of I by SuperLU, in symmetric mode."""
    matrix = sparse.csc_array(matrix)
    shift = 1e-9 * matrix.diagonal().mean()
    lifted = sparse.csc_array(matrix + shift * sparse.eye_array(matrix.shape[0]))
    options = {"SymmetricMode": True}
    return lambda: splu(lifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
