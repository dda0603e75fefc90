"""A loaded bundle, without HTTP."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from onnx import numpy_helper

from shapespace.bundle.reader import read_bundle
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.model.decoder import TOLERANCE, MeshChoice
from shapespace.model.latent_space import NotFiniteError
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.service.use_cases.shape_formats import summarise
from shapespace.solve.outcome import Status
from tests.service.bundles import networks, seal, start_network, write_bundle


@pytest.fixture
def steep(tmp_path: Path) -> ShapeModel:
    """A model whose networks overflow at finite codes."""
    folder = write_bundle(tmp_path, start=True)
    for file, model in (("factor-0.onnx", networks()["factor-0.onnx"]), ("start.onnx", start_network())):
        weight = model.graph.initializer[0]
        values = numpy_helper.to_array(weight).copy()
        if file == "start.onnx":
            values[2] = 3e38  # the weight of ``twist``, for which the factors don't overflow
        else:
            values *= 1e10
        weight.CopyFrom(numpy_helper.from_array(values, weight.name))
        (folder / file).write_bytes(model.SerializeToString())
    seal(folder)
    return ShapeModel(read_bundle(folder))


def test_codes_at_which_the_networks_overflow_are_refused(steep: ShapeModel) -> None:
    codes, _ = steep.latents.codes([[1e30, 0, 0]])
    for ask in (lambda: steep.shape(codes[0]), lambda: steep.decoder.lengths_and_angles(codes[0])):
        with pytest.raises(NotFiniteError, match="nearer to the bounds"):
            ask()


def test_a_start_that_is_not_finite_is_not_used(steep: ShapeModel) -> None:
    codes, _ = steep.latents.codes([[0, 0.1, 1.5]])
    shape = steep.shape(codes[0])
    assert shape.diagnostics.status is Status.CONVERGED
    assert np.isfinite(shape.vertices).all()


def test_the_summary_of_several_shapes_is_their_worst(tmp_path: Path) -> None:
    model = ShapeModel(read_bundle(write_bundle(tmp_path)))
    good = model.decoder.reference_shape().diagnostics
    bad = dataclasses.replace(good, status=Status.STALLED, iterations=9, residual=0.5, inside_bounds=False)
    folded = dataclasses.replace(good, flipped_faces=4, integrability=0.2, plausibility=1.5)
    assert summarise([good, bad, folded]) == {
        "status": "stalled",
        "iterations": 9,
        "residual": 0.5,
        "flipped_faces": 4,
        "integrability": 0.2,
        "plausibility": 1.5,
        "inside_bounds": False,
        "model": model.digest,
        "quality": "full",
    }
    draft = dataclasses.replace(good, quality=Quality.DRAFT)
    assert summarise([good, draft])["quality"] == "draft"
    assert summarise([good, good])["status"] == "converged"


@pytest.fixture(scope="module", params=["figure/4", "freaky-torus/1"])
def bundled(request: pytest.FixtureRequest) -> ShapeModel:
    return ShapeModel(read_bundle(Path(__file__).parents[3] / "models" / request.param))


def wide_codes(model: ShapeModel, count: int) -> np.ndarray:
    """Codes in a box a quarter wider than the bounds; farther out some have two equally near shapes."""
    centre, radius = (model.latents.upper + model.latents.lower) / 2, (model.latents.upper - model.latents.lower) / 2
    offsets = 1.25 * radius * np.random.default_rng(6).uniform(-1, 1, (count, len(radius)))
    return model.latents.codes((centre + offsets).tolist())[0]


def test_every_start_ends_in_one_shape(bundled: ShapeModel) -> None:
    """To 1e-4 of the diagonal, from the server's initial guess, the reference, and another code's shape."""
    reference, codes = bundled.reference, wide_codes(bundled, 4)
    solver = Reconstructor(reference, bundled.manifest.eta_reconstruction)
    other = bundled.shape(codes[-1], mesh=MeshChoice.COARSE, quality="full").vertices / bundled.manifest.scale
    for code in codes[:-1]:
        shape = bundled.shape(code, mesh=MeshChoice.COARSE, quality="full")
        assert shape.diagnostics.status is Status.CONVERGED
        target = bundled.decoder._networks(code[None])[1][0]
        for start in (reference.vertices, other):
            found = solver(target, start, tolerance=TOLERANCE)
            assert found.status is Status.CONVERGED
            aligned = bundled.manifest.scale * align(found.vertices, reference.vertices)
            assert np.abs(aligned - shape.vertices).max() < 1e-4 * bundled.manifest.scale * reference.diagonal


def test_a_shape_does_not_depend_on_what_was_solved_before(bundled: ShapeModel) -> None:
    first, second = wide_codes(bundled, 2)
    fresh = bundled.shape(first)
    bundled.shape(second)
    again = bundled.shape(first)
    assert np.array_equal(again.vertices, fresh.vertices)
    assert again.diagnostics == fresh.diagnostics
