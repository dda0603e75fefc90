"""Use cases without HTTP: answers, diagnostics and timings as data, and errors without HTTP status."""

import asyncio
import io
import json
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from typing import TypeVar

import numpy as np
import pytest

from shapespace.bundle.reader import read_bundle
from shapespace.coordinates.nric import nric
from shapespace.files.colouring import Quantity
from shapespace.files.formats import MESH_FORMATS
from shapespace.model.decoder import MeshChoice, Quality
from shapespace.model.edit import InvalidTargetError
from shapespace.model.exact_shapes import NoTangentSpaceError
from shapespace.model.latent_space import Bounds
from shapespace.model.options import EditOptions, EncodeOptions, Target
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.sandbox import Sandbox
from shapespace.service.limits.workers import BusyError, Caller, DeadlineError, DisconnectedError, Workers
from shapespace.service.use_cases import batch, codes, many_shapes
from shapespace.service.use_cases.animation import Animation
from shapespace.service.use_cases.batch import (
    EncodedFile,
    PiecewiseFile,
    TooManyCodesError,
)
from shapespace.service.use_cases.many_shapes import infer, vertices_file
from shapespace.service.use_cases.one_shape import ColourOptions, ShapeRequest, shape_file
from shapespace.service.use_cases.sequence import (
    TooManyFramesError,
    UnknownFrameError,
    frame_code,
    interpolation_id,
    sequence_file,
    sequence_lines,
)
from shapespace.service.use_cases.uploads import UnknownFormatError, UnusableMeshError
from tests.service.bundles import SCALE, expected_nric, write_bundle

T = TypeVar("T")
CODES = [[0.1, 0.7, 0.4], [-0.1, 2.0, 0.9]]


async def _stays() -> Exception:
    await asyncio.Event().wait()
    raise AssertionError


CALLER = Caller("somebody", _stays)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ShapeModel:
    return ShapeModel(read_bundle(write_bundle(tmp_path_factory.mktemp("bundles"))), 2)


@pytest.fixture
def sandbox() -> Iterator[Sandbox]:
    with Sandbox(1) as sandbox:
        yield sandbox


@asynccontextmanager
async def working(deadline: float = 60, queue: int = 4) -> AsyncIterator[Workers]:
    workers = Workers(2, queue, deadline)
    try:
        yield workers
    finally:
        workers.close()


def run(use_case: Callable[[Workers], Awaitable[T]], deadline: float = 60) -> T:
    async def main() -> T:
        async with working(deadline) as workers:
            answer = await use_case(workers)
            assert workers.places.used == workers.streams.used == workers.memory.used == 0
            return answer

    return asyncio.run(main())


def content(written: EncodedFile) -> bytes:
    assert isinstance(written.content, bytes)
    return written.content


def test_a_shape_is_a_file_with_diagnostics_and_timings(model: ShapeModel) -> None:
    code = model.latents.code(CODES[0])
    found = run(lambda workers: shape_file(workers, CALLER, model, ShapeRequest(code, MeshChoice.FINE, "json")))
    assert found.diagnostics.status == "converged"
    assert found.diagnostics.model == model.digest
    assert set(found.seconds) == {"network", "reconstruct", "encode"}
    assert min(found.seconds.values()) > 0
    assert found.legend is None
    z = nric(np.array(json.loads(found.content)["vertices"]) / SCALE, model.reference.connectivity)
    assert np.abs(z - expected_nric(np.array(CODES[0])))[: len(z) // 2].max() < 0.1


def test_without_a_code_it_is_the_reference_and_colours_come_with_a_legend(model: ShapeModel) -> None:
    colour_by = ColourOptions(Quantity.STRETCH, model.latents.code(CODES[1]))
    wanted = ShapeRequest(None, MeshChoice.FINE, "json", colour_by=colour_by)
    found = run(lambda workers: shape_file(workers, CALLER, model, wanted))
    answer = json.loads(found.content)
    assert np.allclose(answer["vertices"], SCALE * model.reference.vertices, atol=1e-5)
    assert found.legend
    assert found.legend["quantity"] == "stretch"
    assert len(answer["color"]["values"]) == len(answer["vertices"])
    assert found.seconds["reconstruct"] > 0, "the time to reconstruct the other shape"


def test_a_large_file_comes_in_pieces_and_holds_its_memory_until_it_is_read(
    model: ShapeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def both(workers: Workers) -> tuple[bytes, bytes]:
        ask = (workers, CALLER, model, CODES, Bounds.ALLOW, MeshChoice.FINE, "json")
        whole = content(await vertices_file(*ask))
        monkeypatch.setattr(batch, "WHOLE_FILE_BYTES", 100)
        file = (await vertices_file(*ask)).content
        assert isinstance(file, PiecewiseFile)
        assert workers.memory.used > 0
        assert workers.places.used == 0
        with file:
            pieces = [bytes(piece) async for piece in file]
        assert workers.memory.used == 0
        assert len(pieces) > 4
        return whole, b"".join(pieces)

    whole, pieces = run(both)
    assert whole == pieces


def test_frames_are_those_of_one_file_and_of_the_lines(model: ShapeModel) -> None:
    animation = Animation(keyframes=CODES, frames=3)

    async def both(workers: Workers) -> tuple[EncodedFile, list[bytes]]:
        written = await sequence_file(workers, CALLER, model, animation, Quality.FULL, "npz")
        return written, [line async for line in sequence_lines(workers, CALLER, model, animation, Quality.FULL)]

    written, lines = run(both)
    with np.load(io.BytesIO(content(written))) as arrays:
        for k, line in enumerate(map(json.loads, lines)):
            assert line["frame"] == k
            assert np.allclose(line["vertices"], arrays["vertices"][k])
    assert len(lines) == 3
    found, digest = Animation.from_id(interpolation_id(model, animation, 3))
    assert (found.frames, model.digest.startswith(digest)) == (3, True)
    assert np.allclose(frame_code(model, animation, 2)[0], CODES[1])
    with pytest.raises(UnknownFrameError, match="from 0 to 2"):
        frame_code(model, animation, 3)
    with pytest.raises(TooManyFramesError, match="the limit is 2"):
        interpolation_id(model, animation, 2)


def test_a_mesh_is_searched_for_its_code(model: ShapeModel, sandbox: Sandbox) -> None:
    code = model.latents.codes([CODES[0]])[0][0]
    file = MESH_FORMATS["obj"].encode(model.shape(code).vertices, model.reference.faces, None)

    def upload(data: bytes, format: str | None = None) -> codes.Upload:
        return codes.Upload(deque([memoryview(data)]), "model/obj", format)

    def encode(given: codes.Upload) -> codes.Found:
        return run(lambda workers: codes.encode(workers, sandbox, CALLER, lambda _: (model, EncodeOptions()), given, 1))

    found = encode(upload(file))
    assert np.allclose(json.loads(found.content)["latent"], code, atol=1e-3)
    assert set(found.seconds) == {"read", "search"}
    with pytest.raises(UnusableMeshError):
        encode(upload(b"v 1 2"))
    with pytest.raises(UnknownFormatError, match="no format 'abc'"):
        encode(upload(file, "abc"))


def test_a_vertex_is_pulled_to_where_another_code_has_it(model: ShapeModel) -> None:
    goal = model.shape(model.latents.codes([[0.15, 0.0, 0.0]])[0][0]).vertices
    targets = [Target(k, goal[k].tolist()) for k in (0, 20, 40)]

    def edit(targets: list[Target]) -> codes.Found:
        options = EditOptions(prior=0.0)
        return run(lambda workers: codes.edit(workers, CALLER, model, [0.0, 0.0, 0.0], targets, options, 0))

    found = edit(targets)
    assert max(json.loads(found.content)["distances"]) < 1e-2
    assert set(found.seconds) == {"search"}
    for bad in ([Target(len(goal), [0, 0, 0])], targets * len(goal)):
        with pytest.raises(InvalidTargetError):
            edit(bad)


def test_more_than_an_answer_may_hold_is_refused_before_any_work(
    model: ShapeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many_shapes, "MOST_VERTICES", len(model.reference.vertices))
    ask = (CALLER, model, CODES, Bounds.ALLOW, MeshChoice.FINE, "json")
    with pytest.raises(TooManyCodesError, match="Ask for 1 at most"):
        run(lambda workers: vertices_file(workers, *ask))
    with pytest.raises(NoTangentSpaceError):
        run(lambda workers: vertices_file(workers, *ask, exponentials=True))


def test_both_outputs_together_may_be_more_than_an_answer_holds(
    model: ShapeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many_shapes, "MOST_VERTICES", len(CODES) * len(model.reference.vertices))

    def ask(outputs: list[str]) -> EncodedFile:
        latents, write = np.array(CODES), lambda arrays: (iter([b"x"]), {})
        return run(
            lambda workers: infer(
                workers, CALLER, model, latents, Bounds.ALLOW, MeshChoice.FINE, Quality.FULL, outputs, write
            )
        )

    assert content(ask(["vertices"])) == b"x"
    with pytest.raises(TooManyCodesError, match="too many for both outputs"):
        ask(["nric", "vertices"])
    monkeypatch.setattr(many_shapes, "MOST_VERTICES", len(model.reference.vertices))
    with pytest.raises(TooManyCodesError, match="Ask for 1 at most"):
        ask(["vertices"])


def test_work_ends_by_its_deadline_and_when_its_caller_leaves(model: ShapeModel) -> None:
    code = model.latents.code(CODES[0])

    def ask(caller: Caller) -> Callable[[Workers], Awaitable[object]]:
        return lambda workers: shape_file(workers, caller, model, ShapeRequest(code, MeshChoice.FINE, "json"))

    with pytest.raises(DeadlineError, match="within 1e-06 s"):
        run(ask(CALLER), deadline=1e-6)

    async def leaves() -> Exception:
        return DisconnectedError("gone")

    async def wait(workers: Workers) -> None:
        async with workers.admit(Caller("", leaves)) as call:
            await workers.run(lambda call: time.sleep(0.5), call)

    with pytest.raises(DisconnectedError, match="gone"):
        run(wait)


def test_one_caller_leaves_places_for_others(model: ShapeModel) -> None:
    async def fill(workers: Workers) -> None:
        share = 5  # three quarters of two threads and four places in the queue, rounded up
        async with asyncio.TaskGroup() as group:
            held = asyncio.Event()

            async def hold() -> None:
                async with workers.admit(CALLER):
                    await held.wait()

            for _ in range(share):
                group.create_task(hold())
            await asyncio.sleep(0)
            with pytest.raises(BusyError, match="for this client"):
                await shape_file(workers, CALLER, model, ShapeRequest(None, MeshChoice.FINE, "json"))
            other = Caller("somebody else", _stays)
            assert (await shape_file(workers, other, model, ShapeRequest(None, MeshChoice.FINE, "json"))).content
            held.set()

    run(fill)
