"""Faults of meshes in correspondence: unusual shapes and noise are no faults."""

import numpy as np
import pytest

from shapespace.mesh.rigid_motion import align
from shapespace.model.decoder import MeshChoice
from shapespace.model.encode_faults import EncodeCause, OrderCheck
from shapespace.model.shape_model import ShapeModel, load
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status
from tests.service.conftest import ROOT


@pytest.fixture(scope="module", params=["figure", "freaky-torus"])
def bundled(request: pytest.FixtureRequest) -> ShapeModel:
    return load(ROOT / "models" / request.param)


def test_noise_and_a_far_shape_are_no_faults_and_another_order_is(
    bundled: ShapeModel, rng: np.random.Generator
) -> None:
    check = OrderCheck(
        bundled.decoder.mesh(MeshChoice.FINE).connectivity, np.linalg.norm(np.ptp(bundled.vertices, axis=0))
    )
    codes = bundled.sample(20, 1)
    codes[:10] = np.where(codes[:10] > (bundled.lower + bundled.upper) / 2, bundled.upper, bundled.lower)
    shapes = bundled.decode(codes)
    for shape, other in zip(shapes, np.roll(shapes, 1, axis=0), strict=True):
        size = np.linalg.norm(np.ptp(shape, axis=0))
        assert check(shape, align(other, shape)) is None
        noisy = shape + 0.01 * size * rng.normal(size=shape.shape)
        assert check(noisy, align(shape, noisy)) is None
        shuffled = rng.permutation(shape)
        found = check(shuffled, align(other, shuffled))
        assert found is not None
        assert found.cause is EncodeCause.ORDER


def test_noise_is_no_mirror_image(model: ShapeModel, rng: np.random.Generator) -> None:
    for code in model.sample(5, 2):
        shape = model.decode(code)
        noisy = shape + 0.01 * np.linalg.norm(np.ptp(shape, axis=0)) * rng.normal(size=shape.shape)
        assert model.encode(noisy).cause is None
        assert model.encode(noisy * [1, -1, 1]).cause is EncodeCause.MIRRORED


def test_another_size_is_named_and_noise_and_a_stretched_shape_are_not(
    bundled: ShapeModel, rng: np.random.Generator
) -> None:
    shape = bundled.decode(bundled.sample(1, 5)[0], mesh="coarse")
    times = 0.9 if bundled.manifest.name == "figure" else 2
    found = bundled.encode(shape * times)
    assert (found.status, found.cause) == (Status.POOR, EncodeCause.SIZE)
    assert f"about {times:.2g}" in found.reason
    noise = 0.01 * np.linalg.norm(np.ptp(shape, axis=0)) * rng.normal(size=shape.shape)
    assert bundled.encode(shape + noise).cause is None
    assert bundled.encode(shape * [1, 1, 0]).cause is EncodeCause.FAR
    assert bundled.encode(shape * [1, 1, 0], fixed={0: float(bundled.upper[0])}).cause is None


def test_a_search_leaves_time_to_complete_its_result(figure: ShapeModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapespace.solve.deadline.COMPLETING_SHARE", 1)
    monkeypatch.setattr("shapespace.solve.deadline.COMPLETING_SECONDS", 1e9)
    found = figure.encode(figure.vertices, deadline=600)
    assert (found.status, found.cause) == (Status.DEADLINE, None)
    assert found.shape.diagnostics.status is Status.CONVERGED


def test_the_deadline_of_a_search_is_earlier_and_ends_with_the_whole() -> None:
    whole = Deadline(100)
    searching = whole.for_searching()
    assert 97 < searching.time - whole.time + 100 < 98.1
    assert not searching.passed
    whole.call_off()
    assert searching.passed
    assert Deadline(-1).for_searching().passed
