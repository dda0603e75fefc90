"""Servers and repositories beside bundles that are refused, harmful, or changed meanwhile: the others are served."""

import logging
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
import pytest

from benchmarks import synthetic
from shapespace.mesh.prolongation import Prolongation
from shapespace.model.shape_model import ShapeModel
from shapespace.service.repository import validation
from shapespace.service.repository.repository import Changes, ModelRepository
from shapespace.service.repository.validation import BundleValidator
from tests.faults.serving import peak_memory
from tests.service import hostile
from tests.service.bundles import SCALE, rescale, seal, write_bundle
from tests.service.conftest import Start
from tests.service.repository.test_bundles import FAULTS, flip_a_bit
from tests.service.watching import samples, value


def test_a_bad_bundle_is_left_out_with_one_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_bundle(tmp_path, "good")
    flip_a_bit(write_bundle(tmp_path, "bad"))
    write_bundle(tmp_path, "half", "1")
    FAULTS["no JSON"][0](write_bundle(tmp_path, "half", "2"))
    with caplog.at_level(logging.ERROR):
        repository = ModelRepository(tmp_path)
    assert [model.manifest.name for model in repository] == ["good", "half"]
    assert repository.versions("half") == ["1"]
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2
    assert all("\n" not in message and "is not served" in message for message in messages)


def test_a_server_starts_without_models_and_says_so(tmp_path: Path, start: Start) -> None:
    flip_a_bit(write_bundle(tmp_path / "models"))
    server = start(tmp_path / "models")
    with httpx.Client(base_url=server.url) as client:
        assert client.get("/v1/models").json() == {"models": []}
        assert client.get("/v2/health/live").status_code == 200
        ready = client.get("/v2/health/ready")
        assert ready.status_code == 503
        assert "models folder" in ready.json()["detail"]
    assert "bundle small/1 is not served: factor-0.onnx" in server.stop()


@pytest.mark.long
def test_a_fine_mesh_of_a_hundred_and_sixty_thousand_vertices_is_no_bomb(tmp_path: Path) -> None:
    folder = synthetic.write(tmp_path, 500, 4)
    coarse, fine = synthetic.capsule(500), synthetic.capsule(160_000)
    prolong = Prolongation.of(coarse, fine)
    arrays = {"fine_vertices": prolong(coarse.vertices), "fine_faces": fine.faces.astype(np.int32), **prolong.arrays()}
    with np.load(folder / "geometry.npz") as known:
        arrays |= known
    for write in (np.savez, np.savez_compressed):
        with (folder / "geometry.npz").open("wb") as file:
            write(file, **arrays)
        seal(folder)
        repository = ModelRepository(tmp_path)
        assert repository.refused == []
        model = next(iter(repository))
        assert model.decoder.fine
        assert len(model.decoder.fine.reference.vertices) > 150_000


def name_with_a_line_break(models: Path) -> None:
    write_bundle(models, "bad").parent.rename(models / "bad\nINFO shapespace: bundle forged is served")


def of(harm: Callable[..., None], **options: object) -> Callable[[Path], object]:
    return lambda models: hostile.hostile(models, "bad", harm, **options)


#: Harmful bundles with correct manifests, and the log line expected for each.
ATTACKS: dict[str, tuple[Callable[[Path], object], str]] = {
    "loops": (of(hostile.loops), "bad/1 is not served: factor-0.onnx does not answer in time, for zeros"),
    "loops, with an if": (of(hostile.loops, nest="if"), "does not answer in time"),
    "loops, with a scan": (of(hostile.loops, nest="scan"), "does not answer in time"),
    "loops at its upper bounds": (of(hostile.loops, beyond=0.15), "does not answer in time, at a code inside"),
    "fails": (of(hostile.fails), "factor-0.onnx fails: "),
    "fails at its upper bounds": (of(hostile.fails, beyond=0.15), "indices element out of data bounds"),
    "allocates": (of(hostile.allocates), "std::bad_alloc"),
    "gives another shape": (of(hostile.changes_shape), "factor-0.onnx gives (2, 384), not (1, 384)"),
    "is not finite": (of(hostile.not_finite), "does not give finite numbers for zeros"),
    "has no training codes": (of(hostile.no_codes), "training_codes is empty"),
    "unpacks": (of(hostile.unpacks), "its arrays would have 170000"),
    "forges a line": (name_with_a_line_break, r"bad\nINFO shapespace: bundle forged is served/1 is not served"),
}


@pytest.mark.parametrize(
    "attack",
    [
        pytest.param(name, marks=[] if name in {"loops", "allocates", "forges a line"} else pytest.mark.long)
        for name in ATTACKS
    ],
)
def test_a_server_starts_beside_any_bundle(tmp_path: Path, start: Start, attack: str) -> None:
    make, line = ATTACKS[attack]
    models = tmp_path / "models"
    write_bundle(models, "good")
    make(models)
    server = start(models, workers=2)
    with httpx.Client(base_url=server.url, timeout=60) as client:
        assert [model["name"] for model in client.get("/v1/models").json()["models"]] == ["good"]
        assert client.get("/v1/models/good/mesh", params={"latent": "0.1,0.7,0.4"}).status_code == 200
        assert value(samples(client), "shapespace_bundles_refused") == 1
    assert peak_memory(server) < 300 * 2**20
    log = server.stop().splitlines()
    assert sum(line in entry for entry in log) == 1, log
    assert not [entry for entry in log if entry.startswith("INFO shapespace: bundle forged")]
    assert len([entry for entry in log if entry.startswith("ERROR ")]) == 1, log


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    found = [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]
    caplog.clear()
    return found


@pytest.mark.long
def test_a_validation_that_never_ends_or_dies_keeps_no_other_bundle_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile.hostile(tmp_path, "a", hostile.doubles)
    write_bundle(tmp_path, "b")
    monkeypatch.setattr(validation, "SECONDS", 8)
    monkeypatch.setattr(validation, "VALIDATE", "tests.service.tasks:crash_where_told")
    repository = ModelRepository(tmp_path)
    assert [model.manifest.name for model in repository] == ["b"]
    assert messages(caplog) == ["bundle a/1 is not served: loaded in a separate process, it took longer than 8 s"]

    write_bundle(tmp_path, "c")
    told = tmp_path / "c" / "crash"
    told.touch()
    assert repository.reload() == Changes(refused=["a/1", "c/1"])
    assert messages(caplog)[-1] == "bundle c/1 is not served: loaded in a separate process, it died of SIGSEGV"

    told.unlink()
    shutil.rmtree(tmp_path / "a")
    assert repository.reload() == Changes(loaded=["c/1"])


class Swapping(BundleValidator):
    """Changes each bundle between its validation and its use."""

    def digest(self, folder: Path) -> str:
        digest = super().digest(folder)
        rescale(folder, 2 * SCALE)
        return digest


def test_only_the_bundle_that_was_tried_is_served(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_bundle(tmp_path, "small")
    repository = ModelRepository(tmp_path, validator=Swapping())
    assert list(repository) == []
    assert messages(caplog) == ["bundle small/1 is not served: its files changed while the server tested it"]
    assert repository.reload() == Changes(loaded=["small/1"])
    assert repository.get("small").manifest.scale == 2 * SCALE


def test_what_nobody_expected_is_a_line_as_well(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b", "c"):
        write_bundle(tmp_path, name)
    real = ModelRepository._load

    def broken(self: ModelRepository, folder: Path, *more: object) -> ShapeModel:
        if folder.parent.name == "b":
            raise RuntimeError("surprise\nINFO forged")
        return real(self, folder, *more)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(ModelRepository, "_load", broken)
        repository = ModelRepository(tmp_path)
    assert [model.manifest.name for model in repository] == ["a", "c"]
    (line,) = messages(caplog)
    place = f"{Path(__file__).name}, line "
    assert line.startswith(f"bundle b/1 is not served: RuntimeError: surprise INFO forged ({place}")
    assert repository.reload() == Changes(loaded=["b/1"])

    listed = Path.iterdir

    def unreadable(path: Path) -> object:
        if path == tmp_path / "b":
            raise PermissionError(13, "Permission denied", str(path))
        return listed(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", unreadable)
        assert repository.reload() == Changes(refused=["b"])
        assert [model.manifest.name for model in repository] == ["a", "b", "c"]
        assert repository.signature()
    assert "you may not read or write there" in messages(caplog)[0]
    assert repository.reload() == Changes()


def test_a_bundle_that_is_served_already_is_not_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bundle(tmp_path, "small")
    repository = ModelRepository(tmp_path)
    model = repository.get("small")
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    assert repository.reload() == Changes()
    assert repository.get("small") is model
    flip_a_bit(tmp_path / "small" / "1")
    assert repository.reload() == Changes(refused=["small/1"])
    FAULTS["no manifest"][0](tmp_path / "small" / "1")
    assert repository.reload() == Changes(refused=["small/1"])
    assert repository.get("small") is model
