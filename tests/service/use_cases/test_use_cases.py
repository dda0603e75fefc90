"""Use cases without HTTP: large files, limits of an answer, and places for other callers."""

import asyncio
import threading
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest

from shapespace.bundle.reader import read_bundle
from shapespace.model.decoder import MeshChoice
from shapespace.model.exact_shapes import NoTangentSpaceError
from shapespace.model.latent_space import Bounds
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.workers import Caller, Workers
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases import batch, many_shapes
from shapespace.service.use_cases.batch import EncodedFile, PiecewiseFile
from shapespace.service.use_cases.many_shapes import infer, vertices_file
from shapespace.service.use_cases.one_shape import ShapeRequest, shape_file
from tests.service.bundles import write_bundle

T = TypeVar("T")
CODES = [[0.1, 0.7, 0.4], [-0.1, 2.0, 0.9]]


async def _stays() -> Exception:
    await asyncio.Event().wait()
    raise AssertionError


def caller(workers: Workers, client: str = "somebody", *, long: bool = False) -> Caller:
    return Caller(workers, client, _stays, long)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ShapeModel:
    return ShapeModel(read_bundle(write_bundle(tmp_path_factory.mktemp("bundles"))), 2)


def run(use_case: Callable[[Workers], Awaitable[T]]) -> T:
    async def main() -> T:
        workers = Workers(2, 4, deadline=60)
        try:
            answer = await use_case(workers)
            assert workers.places.used == workers.streams.used == workers.memory.used == 0
            return answer
        finally:
            workers.close()

    return asyncio.run(main())


def content(written: EncodedFile) -> bytes:
    assert isinstance(written.content, bytes)
    return written.content


def test_a_large_file_comes_in_pieces_and_holds_its_memory_until_it_is_read(
    model: ShapeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def both(workers: Workers) -> tuple[bytes, bytes]:
        ask = (caller(workers), model, CODES, Bounds.ALLOW, MeshChoice.FINE, "json")
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


def test_more_than_an_answer_may_hold_is_refused_before_any_work(
    model: ShapeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many_shapes, "MOST_VERTICES", len(model.reference.vertices))
    ask = (model, CODES, Bounds.ALLOW, MeshChoice.FINE, "json")
    with pytest.raises(RefusedError, match="Ask for 1 at most"):
        run(lambda workers: vertices_file(caller(workers), *ask))
    with pytest.raises(NoTangentSpaceError):
        run(lambda workers: vertices_file(caller(workers), *ask, exponentials=True))


def test_both_outputs_together_may_be_more_than_an_answer_holds(
    model: ShapeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many_shapes, "MOST_VERTICES", len(CODES) * len(model.reference.vertices))

    def ask(outputs: list[str]) -> EncodedFile:
        latents, write = np.array(CODES), lambda arrays: (iter([b"x"]), {})
        return run(
            lambda workers: infer(
                caller(workers), model, latents, Bounds.ALLOW, MeshChoice.FINE, Quality.FULL, outputs, write
            )
        )

    assert content(ask(["vertices"])) == b"x"
    with pytest.raises(RefusedError, match="too many for both outputs"):
        ask(["nric", "vertices"])
    monkeypatch.setattr(many_shapes, "MOST_VERTICES", len(model.reference.vertices))
    with pytest.raises(RefusedError, match="Ask for 1 at most"):
        ask(["vertices"])


def test_long_work_leaves_threads_to_short_work_and_clients_take_turns() -> None:
    """One client has long work for all threads and more; others come later."""

    async def ask(workers: Workers) -> None:
        many, other = caller(workers, long=True), caller(workers, "somebody else", long=True)
        running: list[str] = []
        go_on = {name: threading.Event() for name in ("m0", "m1", "m2", "m3", "o0", "o1")}

        def hold(name: str) -> Callable[[object], None]:
            def work(_: object) -> None:
                running.append(name)
                assert go_on[name].wait(60)

            return work

        async def started(count: int) -> None:
            while len(running) < count:
                await asyncio.sleep(0.01)

        async with asyncio.TaskGroup() as group:
            for name in go_on:
                group.create_task((many if name[0] == "m" else other).run(hold(name)))
            await started(1)
            for short in (caller(workers), replace(other, long=False)):
                await short.run(lambda _: running.append("short"))
            assert running == ["m0", "short", "short"], "the other thread runs short work only"
            for count, name in enumerate(("m0", "o0", "m1", "o1", "m2"), 4):
                go_on[name].set()
                await started(count)
            go_on["m3"].set()
        assert running[3:] == ["o0", "m1", "o1", "m2", "m3"], "in turn, not in the order of their coming"

    run(ask)


def test_one_caller_leaves_places_for_others(model: ShapeModel) -> None:
    async def fill(workers: Workers) -> None:
        share = 5  # three quarters of two threads and four places in the queue, rounded up
        async with asyncio.TaskGroup() as group:
            held = asyncio.Event()

            async def hold() -> None:
                async with caller(workers).admit():
                    await held.wait()

            for _ in range(share):
                group.create_task(hold())
            await asyncio.sleep(0)
            with pytest.raises(RefusedError, match="for this client"):
                await shape_file(caller(workers), model, ShapeRequest(None, MeshChoice.FINE, "json"))
            other = caller(workers, "somebody else")
            assert (await shape_file(other, model, ShapeRequest(None, MeshChoice.FINE, "json"))).content
            held.set()

    run(fill)
