"""``quality=auto``, the default: as close to exact shapes as ``full``, in fewer steps; codes far outside the bounds."""

import copy
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from shapespace.bundle.writer import amend_bundle
from shapespace.mesh.rigid_motion import align
from shapespace.model.accuracy import measure_accuracy
from shapespace.model.decoder import ITERATIONS_OUTSIDE, TOLERANCE, MeshChoice
from shapespace.model.exact_shapes import exact_shape
from shapespace.model.latent_space import Distribution
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel, load
from shapespace.training.collection.generators.freaky_torus import vertices
from tests.service.calls.test_drafts import CODE, FAR, LATENT, MODEL, positions
from tests.service.conftest import ROOT, Start


def diagnostics(answer: httpx.Response) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(answer.raise_for_status().headers["Shape-Diagnostics"])
    return found


@pytest.fixture(scope="module", params=["figure", "freaky-torus"])
def model(request: pytest.FixtureRequest) -> ShapeModel:
    found = load(ROOT / "models" / request.param)
    assert measure_accuracy(found.decoder).auto_error == found.decoder.auto is not None
    return found


def exact(model: ShapeModel, code: np.ndarray) -> np.ndarray:
    """The coarse shape that the networks approximate."""
    if model.decoder.modes is None:
        return vertices(code[None].astype(float))[0]
    answer = np.zeros_like(model.mesh("coarse").vertices, dtype=np.float32)
    found = exact_shape(model.decoder, code, answer, MeshChoice.COARSE).vertices
    assert found is not None
    return found


@pytest.mark.parametrize("count", [25, pytest.param(1000, marks=pytest.mark.long)])
def test_auto_is_at_most_a_tenth_further_from_exact_shapes_than_full(model: ShapeModel, count: int) -> None:
    """On average; for single codes too, where all drafts are improved."""
    away: dict[str, list[float]] = {"full": [], "auto": []}
    for code in model.sample(count, seed=1):
        true = exact(model, code)
        for quality, distances in away.items():
            found = model.decode(code, "coarse", quality=Quality(quality))
            distances.append(float(np.linalg.norm(align(found, true) - true, axis=1).mean()))
    full, auto = np.array([*away.values()])
    assert model.decoder.auto is not None
    some_drafts = model.decoder.auto.draft_misfit > 0
    assert auto.mean() <= (1.1 if some_drafts else 1.02) * full.mean()
    assert np.quantile(auto / full, 0.95) <= (1.7 if some_drafts else 1.1)


def test_auto_takes_fewer_steps_than_full(model: ShapeModel) -> None:
    codes = model.sample(10)
    auto, full = (
        sum(model.shape(code, quality=quality).diagnostics.iterations for code in codes)
        for quality in (Quality.AUTO, Quality.FULL)
    )
    assert 2 * auto < full


def test_drafts_are_answered_where_they_are_good_for_half_of_the_codes_at_least(model: ShapeModel) -> None:
    found = [model.shape(code).diagnostics for code in model.sample(40)]
    drafts = [each for each in found if not each.iterations]
    assert model.decoder.auto is not None
    good = model.decoder.auto.draft_misfit
    assert all(each.residual <= good for each in drafts)
    assert (len(drafts) > 14) == (good > 0) == (model.manifest.name == "freaky-torus")
    assert all(each.quality == "auto" for each in found)


def test_a_model_without_a_measured_tolerance_answers_full(model: ShapeModel) -> None:
    decoder = copy.copy(model.decoder)
    decoder.auto = None
    auto, full = (decoder.shape(model.sample(1)[0], quality=quality) for quality in (Quality.AUTO, Quality.FULL))
    assert auto.diagnostics == full.diagnostics
    np.testing.assert_array_equal(auto.vertices, full.vertices)


def test_without_a_measured_error_auto_is_as_accurate_as_full_shapes_are(model: ShapeModel) -> None:
    decoder = copy.copy(model.decoder)
    decoder.manifest = decoder.manifest.model_copy(update={"figures": {}})
    measured = measure_accuracy(decoder).auto_error
    assert measured is not None or model.manifest.name == "freaky-torus"
    assert measured is None or measured.mean <= TOLERANCE


def test_codes_whose_frames_are_inconsistent_take_few_steps_too() -> None:
    torus = load(ROOT / "models" / "freaky-torus")
    codes = torus.decoder.latents.sample(2600, 7, Distribution.UNIFORM)
    for k in (489, 1051):
        auto, full = (torus.shape(codes[k], mesh=MeshChoice.COARSE, quality=q) for q in (Quality.AUTO, Quality.FULL))
        assert full.diagnostics.iterations > 50
        assert auto.diagnostics.iterations <= 4  # 3 or 4, by the processor
        assert auto.diagnostics.flipped_faces == 0
        true = exact(torus, codes[k])
        auto_error, full_error = (
            np.linalg.norm(align(shape.vertices, true) - true, axis=1).mean() for shape in (auto, full)
        )
        assert auto_error < 3 * full_error
    # Where a few steps leave folded faces, the shape is solved as for full.
    auto, full = (torus.shape(codes[849], quality=quality).diagnostics for quality in (Quality.AUTO, Quality.FULL))
    assert auto == dataclasses.replace(full, quality="auto")


def test_every_call_answers_auto_by_default(tmp_path: Path, start: Start) -> None:
    shutil.copytree(ROOT / "models" / "figure", tmp_path / "figure")
    folder = next((tmp_path / "figure").iterdir())
    measured = measure_accuracy(load(folder).decoder).auto_error
    amend_bundle(folder, auto_error=measured)
    with httpx.Client(base_url=start(tmp_path).url, timeout=60) as client:
        card = client.get(MODEL).json()
        assert 0 < card["auto_error"]["mean"] < card["auto_error"]["p95"] < card["draft_error"]["p95"] / 10
        query = {"latent": LATENT, "format": "npz"}
        default = client.get(f"{MODEL}/mesh", params=query)
        assert diagnostics(default)["quality"] == "auto"
        by_name = {q: client.get(f"{MODEL}/mesh", params={**query, "quality": q}) for q in ("auto", "full", "draft")}
        assert by_name["auto"].content == default.content
        assert len({answer.headers["ETag"] for answer in (default, *by_name.values())}) == 3
        expected = positions(default)
        full, draft = (positions(by_name[name]) for name in ("full", "draft"))
        assert 0 < np.abs(expected - full).max() < np.abs(draft - full).max() / 10

        near = {"atol": 1e-6 * float(np.ptp(expected)), "rtol": 0.0}
        many = client.post(f"{MODEL}/vertices", json={"latents": [CODE, CODE]}).raise_for_status().json()
        np.testing.assert_allclose(many["vertices"][1], expected, **near)
        assert [each["quality"] for each in many["diagnostics"]] == ["auto", "auto"]
        path = client.post(f"{MODEL}/interpolations", json={"keyframes": [CODE, [0.0] * 20], "frames": 12}).json()
        npz = client.get(f"{path['links']['self']}?format=npz")
        assert diagnostics(npz)["quality"] == "auto"
        np.testing.assert_allclose(positions(npz)[0], expected, **near)
        frame = positions(client.get(path["links"]["frames"].replace("{k}", "7"), params={"format": "npz"}))
        np.testing.assert_allclose(positions(npz)[7], frame, **near)
        tensor = {"name": "latent", "shape": [1, 20], "datatype": "FP32", "data": CODE}
        inferred = client.post("/v2/models/figure/infer", json={"inputs": [tensor], "outputs": [{"name": "vertices"}]})
        assert diagnostics(inferred)["quality"] == "auto"

        far = diagnostics(client.post(f"{MODEL}/mesh", json={"latent": FAR}))
        assert (far["quality"], far["iterations"] <= ITERATIONS_OUTSIDE) == ("auto", True)
        for size in (99.0, 1e9):
            for name in by_name:
                refused = client.post(f"{MODEL}/mesh", json={"latent": [size] * 20, "quality": name})
                assert (refused.status_code, refused.json()["type"].rpartition(":")[2]) == (422, "not-finite")
                assert "no surface has the predicted lengths" in refused.json()["detail"]
            assert client.post(f"{MODEL}/mesh", json={"latent": [size] * 20, "bounds": "clamp"}).status_code == 200
