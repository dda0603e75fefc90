"""A bundle at work, without HTTP in between."""

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest
from onnx import numpy_helper

from geometry.reconstruction import Status
from service.bundle import read_bundle
from service.encodings import worst
from service.latent_space import NotFiniteError
from service.responses import solve
from service.shape_model import MeshChoice, ShapeModel
from service.workers import DeadlineError, Workers
from tests.service.bundles import networks, seal, start_network, write_bundle


@pytest.fixture
def steep(tmp_path: Path) -> ShapeModel:
    """A model whose networks overflow long before the codes do."""
    folder = write_bundle(tmp_path, start=True)
    for file, model in (("factor-0.onnx", networks()["factor-0.onnx"]), ("start.onnx", start_network())):
        weight = model.graph.initializer[0]
        values = numpy_helper.to_array(weight).copy()
        if file == "start.onnx":
            values[2] = 3e38  # by ``twist``, of which the factors keep their head
        else:
            values *= 1e10
        weight.CopyFrom(numpy_helper.from_array(values, weight.name))
        (folder / file).write_bytes(model.SerializeToString())
    seal(folder)
    return ShapeModel(read_bundle(folder))


def test_codes_at_which_the_networks_overflow_are_refused(steep: ShapeModel) -> None:
    codes, _ = steep.latents.codes([[1e30, 0, 0]])
    for ask in (lambda: steep.shape(codes[0]), lambda: steep.lengths_and_angles(codes)):
        with pytest.raises(NotFiniteError, match="nearer to the bounds"):
            ask()


def test_a_start_that_is_not_finite_is_not_used(steep: ShapeModel) -> None:
    codes, _ = steep.latents.codes([[0, 0.1, 1.5]])
    shape = steep.shape(codes[0])
    assert shape.diagnostics.status is Status.CONVERGED
    assert np.isfinite(shape.vertices).all()


def test_a_deadline_ends_gauss_newton(tmp_path: Path) -> None:
    model = ShapeModel(read_bundle(write_bundle(tmp_path)))
    codes, _ = model.latents.codes([[0.2, 1.0, 1.0]])
    past = time.monotonic() - 1
    assert model.shape(codes[0], deadline=past).diagnostics.status is Status.DEADLINE
    workers = Workers(1, 0, deadline=1)
    with pytest.raises(DeadlineError, match="within 1 s"):
        solve(workers, model, MeshChoice.FINE, (codes[0], True), past)
    workers.close()


def test_the_summary_of_several_shapes_is_their_worst(tmp_path: Path) -> None:
    model = ShapeModel(read_bundle(write_bundle(tmp_path)))
    good = model.reference_shape().diagnostics
    bad = dataclasses.replace(good, status=Status.STALLED, iterations=9, residual=0.5, inside_bounds=False)
    folded = dataclasses.replace(good, flipped_faces=4, integrability=0.2, plausibility=1.5)
    assert worst([good, bad, folded]) == {
        "status": "stalled",
        "iterations": 9,
        "residual": 0.5,
        "flipped_faces": 4,
        "integrability": 0.2,
        "plausibility": 1.5,
        "inside_bounds": False,
        "model": model.digest,
    }
    assert worst([good, good])["status"] == "converged"
