"""Tasks in a separate process: their results, their limits, and that no process is left over."""

import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from shapespace.service.limits.sandbox import Sandbox
from shapespace.service.limits.sandbox_child import GROWTH
from shapespace.service.limits.sandbox_messages import (
    ClosedError,
    DiedError,
    FailedError,
    LateError,
    NoProcessError,
    OutOfMemoryError,
    SandboxError,
)
from shapespace.solve.deadline import Deadline
from tests.service.conftest import ROOT
from tests.service.watching import children_of, eventually

MIB = 2**20
TASK = "tests.service.tasks:perform"


@pytest.fixture
def box() -> Iterator[Sandbox]:
    with Sandbox(2, TASK) as box:
        yield box


def call(box: Sandbox, task: str, body: bytes = b"", seconds: float = 60, memory: int = 256 * MIB, **facts: object):
    pieces = deque(body[k : k + 1000] for k in range(0, len(body), 1000))
    most = len(body) * 4
    return box.call({"task": task, **facts}, pieces, deadline=Deadline(seconds), memory=memory, most=most)


@pytest.fixture
def children() -> Callable[[], set[int]]:
    """A function for the children started since the test began; servers of other tests may run too."""
    before = set(children_of("self"))
    return lambda: set(children_of("self")) - before


def alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def test_facts_bodies_and_arrays_go_there_and_come_back(box: Sandbox) -> None:
    numbers = np.random.default_rng(0).normal(size=(1000, 2))
    facts, arrays = call(box, "echo", numbers.tobytes(), name="ä\n\udcff", many=[1, None, {"x": 0.1}])
    assert (facts["name"], facts["many"]) == ("ä\n\udcff", [1, None, {"x": 0.1}])
    assert arrays["body"].tobytes() == numbers.tobytes()
    _, arrays = call(box, "double", numbers.tobytes())
    assert np.array_equal(arrays["twice"], 2 * numbers)
    assert np.array_equal(arrays["turned"], numbers)
    assert (arrays["none"].shape, arrays["none"].dtype) == ((0, 3), np.int32)


def test_a_body_is_given_away_piece_by_piece(box: Sandbox) -> None:
    body = deque([b"x" * MIB] * 3)
    box.call({"task": "echo"}, body, deadline=Deadline(60), memory=64 * MIB, most=3 * MIB)
    assert not body


def test_one_process_does_one_thing_after_the_other(box: Sandbox) -> None:
    pids = {call(box, "echo")[0]["pid"] for _ in range(5)}
    assert len(pids) == 1
    assert os.getpid() not in pids


def test_a_process_that_is_prepared_is_the_one_that_is_used(children: Callable[[], set[int]], box: Sandbox) -> None:
    box.prepare()
    prepared = children()
    assert call(box, "echo")[0]["pid"] in prepared


def test_several_at_once_and_no_more_than_there_may_be(box: Sandbox) -> None:
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda _: call(box, "echo")[0]["pid"], range(16)))
        assert len(set(found)) <= 2
        deadlines = [Deadline(600), Deadline(600)]
        busy = [threads.submit(box.call, {"task": "wait"}, deadline=each, memory=64 * MIB) for each in deadlines]
        eventually(box._free.empty)
        with pytest.raises(LateError, match="every process was busy"):
            call(box, "echo", seconds=0.5)
        for each in deadlines:
            each.call_off()
        assert all(isinstance(future.exception(), LateError) for future in busy)


@pytest.mark.parametrize("task", ["wait", "spin", "hold"])
def test_what_takes_too_long_is_ended(box: Sandbox, task: str) -> None:
    pid = call(box, "echo")[0]["pid"]
    with pytest.raises(LateError, match="longer than"):
        call(box, task, seconds=1)
    assert not alive(pid)
    assert call(box, "echo")[0]["pid"] != pid


def test_what_nobody_waits_for_any_more_is_ended(box: Sandbox) -> None:
    pid, deadline = call(box, "echo")[0]["pid"], Deadline(60)
    with ThreadPoolExecutor(1) as threads:
        busy = threads.submit(box.call, {"task": "wait"}, deadline=deadline, memory=64 * MIB)
        eventually(lambda: box._free.qsize() == 1)
        deadline.call_off()
        assert isinstance(busy.exception(60), LateError)
    assert not alive(pid)


def test_a_process_that_does_not_listen_is_no_trap(children: Callable[[], set[int]], box: Sandbox) -> None:
    """The child is killed while its body is still being sent."""
    box.prepare()
    (pid,) = children()
    os.kill(pid, signal.SIGSTOP)
    with pytest.raises(LateError):
        call(box, "echo", bytes(8 * MIB), seconds=1)
    assert not alive(pid)


@pytest.mark.parametrize(
    ("task", "error", "sentence"),
    [
        ("crash", DiedError, "it died of SIGSEGV"),
        ("leave", DiedError, "it ended with status 3"),
        ("kill", OutOfMemoryError, "probably because memory ran out"),
        ("babble", DiedError, "can't be read"),
        ("lie", DiedError, "can't be read"),
        ("leave_out", DiedError, "can't be read"),
        ("text", DiedError, "can't be read"),
        ("mistake", FailedError, r"KeyError: 'missing' \(tasks.py, line \d+\)"),
    ],
)
def test_what_breaks_is_told_in_a_sentence_and_the_next_call_works(
    children: Callable[[], set[int]], box: Sandbox, task: str, error: type[SandboxError], sentence: str
) -> None:
    with pytest.raises(error, match=sentence):
        call(box, task)
    assert call(box, "echo", x=1)[0]["x"] == 1
    assert len(children()) == 1


def test_what_a_task_finds_wrong_is_told_as_it_says_it(box: Sandbox) -> None:
    pid = call(box, "echo")[0]["pid"]
    with pytest.raises(FailedError) as found:
        call(box, "refuse")
    assert (found.value.kind, found.value.sentence) == ("nonsense", "It is\nno mesh.")
    assert call(box, "echo")[0]["pid"] == pid


def test_answers_are_no_longer_than_expected(box: Sandbox) -> None:
    with pytest.raises(DiedError):
        box.call({"task": "echo"}, deque([bytes(100)]), deadline=Deadline(60), memory=MIB, most=99)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits what a process maps")
def test_memory_is_limited_for_each_task(box: Sandbox) -> None:
    for _ in range(2):
        pid = call(box, "take", size=100 * MIB, memory=150 * MIB)[0]["taken"]
        with pytest.raises(OutOfMemoryError):
            call(box, "take", size=200 * MIB, memory=150 * MIB)
    # The limit is on the growth; memory used before, the body included, does not count.
    assert call(box, "echo", bytes(50 * MIB), memory=30 * MIB)[0]["pid"] != pid


def test_a_process_that_keeps_too_much_is_replaced(box: Sandbox) -> None:
    pid = call(box, "echo")[0]["pid"]
    assert call(box, "keep", size=20 * MIB)[0]["pid"] == pid
    assert call(box, "keep", size=GROWTH)[0]["pid"] == pid
    assert call(box, "echo")[0]["pid"] != pid
    assert not alive(pid)


def test_it_knows_no_settings_writes_no_file_and_shares_no_stream(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, box: Sandbox
) -> None:
    monkeypatch.setenv("SHAPESPACE_API_KEY", "secret")
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    facts, _ = call(box, "about", file=str(tmp_path / "file"))
    assert facts["settings"] == []
    assert facts["streams"] == ["/dev/null"] * 3
    assert not facts["written"]
    assert "" not in facts["path"]


def test_a_process_that_died_meanwhile_is_replaced(box: Sandbox) -> None:
    pid = call(box, "echo")[0]["pid"]
    os.kill(pid, signal.SIGKILL)
    # All threads: one may end a moment after the main thread, and until then the process can't be waited for.
    eventually(lambda: len(os.listdir(f"/proc/{pid}/task")) == 1)
    eventually(lambda: Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z")
    assert call(box, "echo")[0]["pid"] != pid
    assert not alive(pid)


def test_signals_to_the_whole_group_are_for_the_parent(box: Sandbox) -> None:
    pid = call(box, "echo")[0]["pid"]
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(pid, number)
    assert call(box, "echo")[0]["pid"] == pid


def test_closing_ends_what_runs_and_leaves_nothing(children: Callable[[], set[int]]) -> None:
    box = Sandbox(2, TASK)
    with ThreadPoolExecutor(2) as threads:
        busy = threads.submit(call, box, "spin")
        call(box, "echo")
        eventually(lambda: len(children()) == 2)
        box.close()
        assert isinstance(busy.exception(), ClosedError)
    assert children() == set()
    with pytest.raises(ClosedError):
        call(box, "echo")
    box.prepare()
    assert children() == set()


def test_a_process_that_does_not_begin_is_told(monkeypatch: pytest.MonkeyPatch, box: Sandbox) -> None:
    with Sandbox(1, "tests.service.nowhere:none") as nowhere:
        nowhere.prepare()
        with pytest.raises(FailedError, match=r"ModuleNotFoundError: No module named 'tests\.service\.nowhere'"):
            call(nowhere, "echo")
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    box.prepare()
    with pytest.raises(NoProcessError, match="no process can be started"):
        call(box, "echo")


@pytest.mark.parametrize("task", ["echo", "spin"])
def test_nothing_survives_a_parent_that_is_killed(task: str) -> None:
    program = f"""
import sys, threading, time
from shapespace.service.limits.sandbox import Deadline, Sandbox
box = Sandbox(1, "{TASK}")
box.prepare()
call = dict(facts={{"task": "{task}"}}, deadline=Deadline(600), memory=2**28)
threading.Thread(target=lambda: box.call(**call), daemon=True).start()
time.sleep(1)
print(*[child._process.pid for child in box._children], flush=True)
time.sleep(600)
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, env=environment
    ) as parent:
        assert parent.stdout
        pids = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(pids) == 1
        assert all(map(alive, pids))
        parent.kill()
    eventually(lambda: not any(map(alive, pids)))
