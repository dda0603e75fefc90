"""Samples computed by real processes that are killed, without and with a local Dask cluster."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.training.runs import workers
from shapespace.training.runs.sampling import columns, draw, read, split, used
from shapespace.training.runs.workers import WorkersError
from shapespace.training.space.shell_collection import ShellCollection
from tests.training.conftest import TINY, Said
from tests.training.runs.deadly import die_once

DRAW = """
import pickle, sys
from pathlib import Path
from shapespace.training.runs.sampling import draw
collection, latents = pickle.loads(Path(sys.argv[1]).read_bytes())
for _ in draw(collection, Path(sys.argv[2]), latents, 2, "samples", workers=2):
    pass
"""


@pytest.fixture(scope="module")
def collection() -> ShellCollection:
    """An ellipsoid of 162 vertices that bends, twists and swells."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = TriangleMesh.from_arrays(ball.vertices * [2, 1, 1], ball.faces)
    mesh = mesh.with_vertices(mesh.vertices / np.sqrt(mesh.area))
    (x, y, z), o = mesh.vertices.T, np.zeros(162)
    modes = [np.stack(field, axis=1) for field in ((o, o, x**2), (o, x * z, -x * y), (x * y, o, o))]
    factors = {"bend": [0], "twist and swell": [1, 2]}
    ends, codes = (np.full(3, -0.5), np.full(3, 0.5)), np.array([[0.3, -0.2, 0.1], [0.0, 0.4, -0.4]])
    return ShellCollection(mesh, np.stack(modes), *ends, factors, 8, Material(), 2.0, codes)


@pytest.fixture(scope="module")
def latents(collection: ShellCollection) -> FloatArray:
    return collection.coordinates.uniform(20, np.random.default_rng(3))


@pytest.fixture(scope="module")
def serial(collection: ShellCollection, latents: FloatArray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("serial")
    assert list(draw(collection, folder, latents, 7, "samples", workers=1)) == [(7, 20, 0), (14, 20, 0), (20, 20, 0)]
    return folder


def assert_same(folder: Path, other: Path) -> None:
    """Assert that both folders have the same samples bit for bit, none missing and none twice."""
    a, b = read(folder), read(other)
    assert a.index.tolist() == list(range(20))
    for name in ("index", "latents", "asked", "nric", "vertices"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert not list(folder.glob("*.part"))


def wait_for(path: Path, count: int, process: subprocess.Popen) -> None:
    while len(list(path.parent.glob(path.name))) < count:
        assert process.poll() is None, "ended too early"
        time.sleep(0.01)


# ---------------------------------------------------------------- on this machine


def test_processes_draw_what_one_draws(
    collection: ShellCollection, latents: FloatArray, serial: Path, tmp_path: Path
) -> None:
    progress = list(draw(collection, tmp_path, latents, 3, "samples", workers=2))
    assert progress[-1] == (20, 20, 0)
    assert len(progress) == 7
    assert_same(tmp_path, serial)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert list(draw(collection, tmp_path, latents, 3, "samples")) == [(20, 20, 0)]
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before


def test_killed_with_all_its_processes_the_same_call_goes_on(
    collection: ShellCollection, latents: FloatArray, serial: Path, tmp_path: Path
) -> None:
    (tmp_path / "what.pickle").write_bytes(pickle.dumps((collection, latents)))
    folder = tmp_path / "samples"
    command = [sys.executable, "-c", DRAW, str(tmp_path / "what.pickle"), str(folder)]
    process = subprocess.Popen(command, start_new_session=True)
    wait_for(folder / "part-*.npz", 2, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in folder.glob("part-*.npz")}
    assert len(kept) < 10
    for _ in draw(collection, folder, latents, 2, "samples", workers=1):
        pass
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert_same(folder, serial)


def test_parts_of_other_codes_or_damaged_ones_are_drawn_again(
    collection: ShellCollection, latents: FloatArray, serial: Path, tmp_path: Path
) -> None:
    for _ in draw(collection, tmp_path, latents[:4] + 0.1, 2, "samples", workers=1):
        pass
    (tmp_path / "part-00002.npz").write_bytes(b"PK\x03\x04 and no more")
    (tmp_path / "part-00099.npz").write_bytes((tmp_path / "part-00001.npz").read_bytes())
    for _ in draw(collection, tmp_path, latents, 2, "samples", workers=1):
        pass
    assert_same(tmp_path, serial)


def test_a_killed_process_costs_nothing_but_what_kills_all_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "RETRIES", 1)
    found = list(workers.run(partial(die_once, tmp_path / "dead"), range(5), workers=2))
    assert (tmp_path / "dead").exists()
    assert sorted(found) == [(k, k**2) for k in range(5)]
    with closing(workers.run(abs, range(50), workers=2)) as some:
        assert next(iter(some))[0] < 50, "and what is left undone causes no warning"
    with pytest.raises(WorkersError, match="killed several times"):
        list(workers.run(signal.raise_signal, [signal.SIGKILL] * 2, workers=2))


# ---------------------------------------------------------------- on a cluster


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen]]:
    """Start ``dask scheduler`` or ``dask worker``; workers find the scheduler by a file."""
    started = []

    def start(*arguments: str) -> subprocess.Popen:
        meeting = ["--scheduler-file", str(tmp_path / "scheduler.json"), "--no-dashboard"]
        process = subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments, *meeting],
            stderr=subprocess.DEVNULL,
            env={**os.environ, "DASK_TEMPORARY_DIRECTORY": str(tmp_path)},
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


def scheduler_address(dask: Callable[..., subprocess.Popen], folder: Path) -> tuple[subprocess.Popen, str]:
    process = dask("scheduler", "--host", "127.0.0.1", "--port", "0")
    wait_for(folder / "scheduler.json", 1, process)
    while True:
        try:
            return process, json.loads((folder / "scheduler.json").read_text())["address"]
        except json.JSONDecodeError:  # not completely written yet
            time.sleep(0.01)


def test_a_cluster_draws_the_same_though_a_worker_and_then_the_scheduler_are_killed(
    collection: ShellCollection, latents: FloatArray, serial: Path, dask: Callable, tmp_path: Path
) -> None:
    scheduler, address = scheduler_address(dask, tmp_path)
    first, _ = [dask("worker", "--no-nanny", "--nthreads", "1") for _ in range(2)]
    for done, _, _ in draw(collection, tmp_path / "a", latents, 1, "samples", scheduler=address):
        if done == 5:
            first.kill()
    assert_same(tmp_path / "a", serial)

    progress = draw(collection, tmp_path / "b", latents, 1, "samples", scheduler=address)
    for _ in range(5):
        next(progress)
    scheduler.kill()
    with pytest.raises(WorkersError, match="give the same command again") as error:
        list(progress)
    assert "\n" not in str(error.value)
    assert 5 <= len(list((tmp_path / "b").iterdir())) < 20
    for _ in draw(collection, tmp_path / "b", latents, 1, "samples", workers=1):
        pass
    assert_same(tmp_path / "b", serial)


def test_a_cluster_without_workers_is_given_up(dask: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "ABANDONED", 0.5)
    _, address = scheduler_address(dask, tmp_path)
    with pytest.raises(WorkersError, match="has had no worker for"):
        list(workers.run(abs, [1], scheduler=address))


def test_a_scheduler_that_does_not_answer_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    monkeypatch.setattr(workers, "CONNECT", 0.5)
    (tmp_path / "tiny.toml").write_text(TINY)
    said("run", tmp_path / "tiny.toml", "--out", tmp_path / "run", "--scheduler", "tcp://127.0.0.1:9", code=1)
    assert said.errors.startswith("shapespace-train: no Dask scheduler answers at tcp://127.0.0.1:9")
    assert said.errors.count("\n") == 1


# ---------------------------------------------------------------- failures and indices


def test_failed_samples_are_recorded_and_left_out_by_their_index(
    collection: ShellCollection, latents: FloatArray, serial: Path, tmp_path: Path
) -> None:
    torn = latents.copy()
    torn[[2, 3, 6]] = [200.0, 0, 200]
    assert list(draw(collection, tmp_path, torn, 2, "samples", workers=2))[-1] == (20, 20, 3)
    with np.load(tmp_path / "part-00001.npz") as part:
        assert part["status"].tolist() == ["failed", "failed"]
        assert all(reason.startswith(("degenerate: ", "stalled: ")) for reason in part["reason"])
        assert np.isfinite(part["vertices"]).all()
        assert np.isfinite(part["nric"]).all()
    there, whole = read(tmp_path), read(serial)
    assert there.index.tolist() == [k for k in range(20) if k not in (2, 3, 6)]
    assert np.array_equal(there.nric, whole.nric[there.index])
    parts = split(there.index, 0.2, 0.1, np.random.default_rng(0))
    assert sorted(np.concatenate(list(parts.values()))) == there.index.tolist()
    assert [len(parts[name]) for name in ("test", "validation", "train")] == [3, 1, 13]


# ---------------------------------------------------------------- exponentials


def test_codes_are_velocities_at_the_mean(collection: ShellCollection, latents: FloatArray) -> None:
    reference, space = collection.reference, collection.space
    small = 1e-6 * latents[:3]
    shapes = collection.shapes(np.concatenate([np.zeros((1, 3)), small]))
    z = space.nric(reference.vertices)
    np.testing.assert_allclose(shapes.vertices[0], reference.vertices, atol=1e-12)
    tangents = [space.point(reference.vertices).push_forward(d) for d in collection.modes]
    np.testing.assert_allclose(shapes.nric[1:] - z, small @ tangents, atol=1e-10)
    assert collection.latent_names == ("bend", "twist and swell, 1", "twist and swell, 2")
    assert np.isnan(collection.coordinates.period).all()


def test_angles_follow_the_geodesic_past_half_a_turn() -> None:
    book = TriangleMesh.from_arrays(
        np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0]]), np.array([[0, 1, 2], [1, 0, 3]])
    )
    close = np.zeros((1, 4, 3))
    close[0, 2:, 2] = -2.0
    collection = ShellCollection(
        book, close, -np.ones(1), np.ones(1), {"close": [0]}, 32, Material(), 1.0, np.empty((0, 1))
    )
    shapes = collection.shapes(np.array([[0.5], [1.0]]))
    assert shapes.reasons == ["", ""]
    hinge = book.connectivity.edge_count + int(np.flatnonzero(book.connectivity.interior)[0])
    half, whole = shapes.nric[:, hinge]
    assert half == pytest.approx(2, abs=0.1)
    assert whole == pytest.approx(4, abs=0.2)


def test_it_travels_without_its_analysis(collection: ShellCollection, latents: FloatArray) -> None:
    code = latents[:1]
    expected = collection.shapes(code)
    pickled = pickle.dumps(collection)
    assert b"ShellSpace" not in pickled
    assert np.array_equal(pickle.loads(pickled).shapes(code).nric, expected.nric)  # noqa: S301


def test_derivatives_are_those_of_the_shapes(collection: ShellCollection, latents: FloatArray) -> None:
    h, codes = 1e-4, latents[:2]
    found = collection.differentiated.shapes(codes)
    assert np.array_equal(found.nric, collection.shapes(codes).nric)
    for j, step in enumerate(h * np.eye(3)):
        ahead, behind = (collection.shapes(codes + side).nric for side in (step, -step))
        assert found.derivatives[:, j] == pytest.approx((ahead - behind) / (2 * h), abs=1e-5)


def test_a_code_without_a_shape_has_no_derivative(collection: ShellCollection, tmp_path: Path) -> None:
    codes = np.array([[1e3, 0, 0], [0.1, 0, 0]])
    assert list(draw(collection.differentiated, tmp_path, codes, 2, "samples", workers=1)) == [(2, 2, 1)]
    found = columns(tmp_path, "status", "derivatives")
    assert found["status"].tolist() == ["failed", "done"]
    assert not found["derivatives"][0].any()
    assert found["derivatives"][1].any(axis=1).all()


def test_codes_without_a_shape_are_shortened_and_say_so(collection: ShellCollection, tmp_path: Path) -> None:
    asked = collection.coordinates.uniform(6, np.random.default_rng(3))
    reach = next(s for s in np.geomspace(1, 100, 13) if collection.shapes(s * asked[:1]).reasons[0])
    asked[0] *= reach  # just too far for a shape
    asked[1] *= 20 * reach
    assert list(draw(collection, tmp_path / "short", asked, 3, "samples", shorten=True, workers=1))[-1] == (6, 6, 1)
    samples = read(tmp_path / "short")
    assert samples.index.tolist() == [0, 2, 3, 4, 5]
    assert samples.shortened.tolist() == [True, False, False, False, False]
    assert np.array_equal(samples.asked, asked[samples.index])
    share = samples.latents[0] / asked[0]
    assert share == pytest.approx(share[0])
    assert 0.5 < share[0] < 1
    assert np.array_equal(samples.nric, collection.shapes(samples.latents).nric.astype(np.float32))
    codes = used(tmp_path / "short", asked)
    assert np.array_equal(codes[samples.index], samples.latents)
    assert np.array_equal(codes[1], asked[1])
