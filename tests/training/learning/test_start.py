"""The start network: it learns a map that it can represent, also from rigidly moved samples."""

import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from shapespace.bundle.reader import read_bundle
from shapespace.mesh.rigid_motion import align
from shapespace.training.learning.networks import StartNetwork
from shapespace.training.runs.config import load
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.stage import Run
from tests.shapespace.conftest import torus, turned

COORDINATES = Coordinates(np.array([-1.0, 0.0, 2.0]), np.array([1.0, 6.0, 5.0]), np.array([np.nan, 2 * np.pi, np.nan]))


def shapes(latents: np.ndarray) -> np.ndarray:
    """(n, V, 3), quadratic in the bounded coordinates and in cosine and sine of the periodic one."""
    mesh, rng = torus(), np.random.default_rng(3)
    x, angle, y = latents.T
    features = np.stack([x, np.cos(angle), np.sin(angle) * y, x * y, y**2, x * np.cos(angle)], axis=1)
    return mesh.vertices + 0.02 * np.tensordot(features, rng.standard_normal((6, *mesh.vertices.shape)), 1)


def test_a_quadratic_map_is_found_from_shapes_that_lie_anywhere() -> None:
    rng = np.random.default_rng(0)
    latents = COORDINATES.uniform(200, rng)
    vertices = np.stack([turned(shape, rng) for shape in shapes(latents)])
    network = StartNetwork(COORDINATES, torus().vertices)
    codes = torch.as_tensor(latents, dtype=torch.float32)
    network.fit(codes[:150], vertices[:150], (codes[150:], vertices[150:]))
    new = COORDINATES.uniform(20, rng)
    with torch.no_grad():
        found = network(torch.as_tensor(new, dtype=torch.float32)).numpy()
        plain = network(torch.as_tensor(new + np.array([0, 2 * np.pi, 0]), dtype=torch.float32)).numpy()
    np.testing.assert_allclose(plain, found, atol=1e-4)  # the angle counts modulo its period
    expected = align(shapes(new), torus().vertices)
    spread = np.abs(expected - torus().vertices).max()
    # Alignment to the reference is not quadratic, so the error is small, not zero.
    assert np.abs(align(found.astype(float), torus().vertices) - expected).max() < 0.05 * spread


@pytest.mark.long
def test_a_bundle_has_the_start_of_its_samples(tiny_run: Path) -> None:
    folder = tiny_run / "models" / "tiny-torus" / "1"
    bundle = read_bundle(folder)
    assert json.loads((folder / "manifest.json").read_text())["start"] == {
        "file": "start.onnx",
        "input": "latent",
        "output": "vertices",
    }
    run = Run(tiny_run, *load(tiny_run / "config.toml"), tiny_run / "models")
    network = learner_of(run).start()
    codes = np.random.default_rng(4).uniform(0, 6, (5, 4)).astype(np.float32)
    with torch.no_grad():
        expected = network(torch.from_numpy(codes)).numpy()
    answer = onnxruntime.InferenceSession(bundle.networks["start.onnx"]).run(None, {"latent": codes})[0]
    np.testing.assert_allclose(answer, expected, atol=1e-5)
    reference = run.collection.reference
    away = np.abs(run.collection.shapes(codes.astype(float)).vertices - reference.vertices).mean()
    assert np.abs(answer - run.collection.shapes(codes.astype(float)).vertices).mean() < 0.5 * away
