"""What one request costs a server: time on its event loop, memory, and time until the answer."""

import contextlib
import json
import os
import re
import select
import shutil
import signal
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx

from tests.fuzz.meters import Peaks, ProcessorClock
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server
from tests.service.watching import processes

MIB = 2**20
#: Budgets of a request: seconds of one callback of the event loop, and peak bytes in addition to those sent.
LOOP, MEMORY = 0.05, 64 * MIB
#: Seconds for which threads may keep the event loop from running: a computing thread takes the interpreter
#: lock too, and holds it for a while.
STALL = 0.1
#: Deadline of the tested server, in seconds.
DEADLINE = 8.0
#: Seconds after its deadline in which an answer still counts as on time.
LATE = 4.0
#: Repetitions of a request that exceeds a budget.
AGAIN = 5
#: Seconds that the longest answer may take.
LONGEST = 600.0
#: Seconds for which a server may go on working after its answer.
SETTLING = 5.0
#: Seconds within which SIGTERM ends a server that doesn't drain.
ENDING = 3.0
_STATUS = re.compile(rb"HTTP/1\.1 (\d{3}) ")
#: Statuses of 500 and more that are no errors of the server.
_BUSY = {503, 504, 507}
_KEPT = 2**16


@dataclass(frozen=True)
class Request:
    """Bytes for one connection, of one request or several.

    Attributes:
        parts: what is sent, one after the other; a number is a pause in seconds.
        broken: whether it isn't valid HTTP, so that the connection may be closed without an answer.
        half_closed: whether the client closes its sending direction after the last byte.
    """

    parts: Iterable[bytes | float]
    broken: bool = False
    half_closed: bool = False


@dataclass
class Cost:
    """The measured cost of a request.

    Attributes:
        name: what kind of request.
        seed: that made it.
        line: method and target, as far as it is short.
        sent: bytes.
        received: bytes.
        seconds: until the last byte of the answer.
        statuses: of the answers.
        loop: longest callback of the loop, in seconds of CPU time.
        where: name of that callback.
        stall: longest time for which the loop could not run.
        collecting: longest run of the garbage collector within a callback, which ``loop`` includes.
        memory: peak bytes in addition to those before the request and to those sent.
        computing: seconds of CPU time of all threads and child processes.
        faults: errors other than exceeded budgets.
    """

    name: str
    seed: int
    line: str = ""
    sent: int = 0
    received: int = 0
    seconds: float = 0.0
    statuses: list[int] = field(default_factory=list)
    loop: float = 0.0
    where: str = ""
    stall: float = 0.0
    collecting: float = 0.0
    memory: int = 0
    computing: float = 0.0
    faults: list[str] = field(default_factory=list)

    @property
    def over(self) -> list[str]:
        """All faults and exceeded budgets, in words."""
        found = list(self.faults)
        if self.loop > LOOP:
            found.append(f"{1e3 * self.loop:.0f} ms of the loop in {self.where}")
        if self.stall > max(STALL, 1.2 * self.loop):
            found.append(f"{1e3 * self.stall:.0f} ms in which the loop could not run")
        if self.memory > MEMORY:
            found.append(f"{self.memory / MIB:.0f} MiB")
        return found

    @property
    def badness(self) -> float:
        """The largest cost as a multiple of its budget, to sort by."""
        return max(self.loop / LOOP, self.stall / STALL, self.memory / MEMORY, 1e3 * len(self.faults))


class Measured(Server):
    """A server that measures itself, see `tests.fuzz.measured`.

    Args:
        models: folder of bundles.
        deadline: seconds that a request may take.
        settings: as of Server.
    """

    def __init__(self, models: Path, deadline: float, **settings: object) -> None:
        self._folder = TemporaryDirectory()
        self._meter = str(Path(self._folder.name, "meter"))
        self.program = ("-m", "tests.fuzz.measured", self._meter)
        super().__init__(models, deadline=deadline, **settings)
        self.deadline = deadline
        url = httpx.URL(self.url)
        self.place = (url.host, url.port)
        self._logged = 0

    def kill(self) -> None:
        """End it at once, children included."""
        for pid in reversed(self.pids):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.communicate(timeout=60)
        self._folder.cleanup()

    def stop(self) -> str:
        log = super().stop()
        self._folder.cleanup()
        return log

    def ask(self, word: str) -> dict[str, float | str]:
        """Send a word to the meter and return its answer; raises TimeoutError if the interpreter is stuck."""
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(10)
            connection.connect(self._meter)
            connection.sendall(word.encode())
            answer: dict[str, float | str] = json.loads(connection.makefile("rb").read())
            return answer

    @property
    def pids(self) -> list[int]:
        """Ids of the server's process and its children, parents first."""
        return processes(self.process.pid)

    def computing(self) -> float:
        """Seconds of CPU time that the processes have taken so far."""
        total = 0.0
        for pid in self.pids:
            with contextlib.suppress(OSError):
                total += time.clock_gettime((~pid << 3) | 2)  # as clock_getcpuclockid(3)
        return total

    @property
    def busy(self) -> bool:
        """Whether any thread is running or ready to run."""
        for pid in self.pids:
            for place in Path(f"/proc/{pid}/task").glob("*/stat"):
                with contextlib.suppress(OSError):
                    if place.read_text().rpartition(")")[2].split()[0] in "RD":
                        return True
        return False

    def settle(self) -> bool:
        """Wait until no thread computes, except the meter's beat; returns whether that happened in time."""
        clock = ProcessorClock(self.process.pid)
        while clock.seconds < SETTLING:
            looks = []
            for _ in range(5):
                time.sleep(0.01)
                looks.append(self.busy)
            if sum(looks) <= 1:
                return True
        return False

    def new_log(self) -> str:
        """What has been logged since the last call."""
        log = self.log[self._logged :]
        self._logged += len(log)
        return log

    def cost(self, name: str, seed: int, request: Request) -> Cost:
        """Send a request, without others at the same time, and measure its cost."""
        cost = Cost(name, seed)
        self.ask("reset")
        computing, peaks = self.computing(), Peaks(self.process.pid)
        with peaks.watching():
            self.exchange(request, cost)
            if not self.settle():
                cost.faults.append(f"still computing {SETTLING:g} s after its answer")
        cost.computing = max(0.0, self.computing() - computing)
        cost.memory = max(0, peaks.growth - cost.sent)
        try:
            facts = self.ask("read")
        except OSError:
            cost.faults.append("the interpreter is stuck, or gone")
            return cost
        for key, value in facts.items():
            if hasattr(cost, key):
                setattr(cost, key, value)
        log = self.new_log()
        if "Traceback" in log:
            errors = re.findall(r"^Traceback .*?^(\S+.*?)$", log, re.DOTALL | re.MULTILINE)
            cost.faults.append(f"{log.count('Traceback')} tracebacks in the log, of {(errors or [log])[-1][-1000:]}")
        return cost

    def exchange(self, request: Request, cost: Cost) -> None:
        """Send a request, and read until the server closes the connection."""
        clock, began, patience = ProcessorClock(self.process.pid), time.monotonic(), self.deadline + LATE
        answer = bytearray()
        with socket.create_connection(self.place, timeout=10) as connection:
            connection.setblocking(False)
            pieces = iter(request.parts)
            piece, resume, open, heard = memoryview(b""), 0.0, True, 0.0
            while True:
                now = clock.seconds
                # In a stream each frame has a deadline of its own.
                if now - heard > patience or now > LONGEST:
                    fault = "no answer" if not answer else "its answer has no end"
                    cost.faults.append(f"{fault} {now:.0f} s later")
                    break
                if open and not piece and now >= resume:
                    match next(pieces, None):
                        case None:
                            open = False
                            if request.half_closed:
                                with contextlib.suppress(OSError):
                                    connection.shutdown(socket.SHUT_WR)
                        case float(pause):
                            resume = now + pause
                        case bytes(data):
                            piece = memoryview(data)
                            cost.line = cost.line or " ".join(data[:60].decode("latin-1").split()[:2])
                wait = max(0.0, min(0.5, resume - now)) if open and not piece else 0.5
                readable, writable, _ = select.select([connection], [connection] if piece else [], [], wait)
                try:
                    if readable:
                        data = connection.recv(2**20)
                        if not data:
                            break
                        cost.received += len(data)
                        heard = clock.seconds
                        answer += data[: _KEPT - len(answer)] if len(answer) < _KEPT else b""
                    if writable:
                        count = connection.send(piece[: 2**20])
                        cost.sent += count
                        piece = piece[count:]
                except OSError:  # it may refuse and close before it has read all; its answer is read first
                    piece, open = memoryview(b""), False
                    if not readable:
                        continue
                    break
        cost.seconds = time.monotonic() - began
        cost.statuses = [status for status in map(int, _STATUS.findall(bytes(answer))) if status >= 200]
        if not cost.faults and not cost.statuses and not request.broken:
            cost.faults.append("the connection was closed without an answer")
        cost.faults += [f"status {status}" for status in cost.statuses if status >= 500 and status not in _BUSY]


class CostTrial:
    """A server that is replaced when a request has brought it down.

    Args:
        start: starts one.
    """

    def __init__(self, start: Callable[[], Measured]) -> None:
        self._start = start
        self.server = start()

    def try_out(self, name: str, seed: int, make: Callable[[], Request]) -> Cost:
        """Measure a request; if it brings the server down, that is a fault and the server is replaced.

        A request over a budget is measured again, as a busy machine makes measurements too large.
        """
        cost = self.server.cost(name, seed, make())
        for _ in range(AGAIN):
            if cost.faults or not cost.over:
                break
            cost = min(cost, self.server.cost(name, seed, make()), key=lambda cost: cost.badness)
        if self.server.process.poll() is not None:
            cost.faults.append(f"the server ended with {self.server.process.returncode}")
            self._replace()
        elif any("still" in fault or "stuck" in fault or "later" in fault for fault in cost.faults):
            cost.faults += self._end()
            self._replace()
        return cost

    def _end(self) -> list[str]:
        """Send SIGTERM, on which it has to end whatever it computes; returns the faults."""
        self.server.process.terminate()
        clock = ProcessorClock(self.server.process.pid)
        while self.server.process.poll() is None:
            if clock.seconds > ENDING:
                return [f"SIGTERM is ignored for {ENDING:g} s"]
            time.sleep(0.05)
        return []

    def _replace(self) -> None:
        self.server.kill()
        self.server = self._start()


def warm_up(url: str) -> None:
    """Cause all one-time costs: what each worker keeps for each model, also for exact shapes, the process
    for uploads, and the USD library.
    """
    with httpx.Client(base_url=url, timeout=300) as client:
        for model in client.get("/v1/models").raise_for_status().json()["models"]:
            path = f"/v1/models/{model['name']}"
            codes = {"latents": [model["lower"], model["upper"]] * 4}
            client.post(f"{path}/vertices", json=codes)  # may exceed the deadline
            client.post(f"{path}/vertices", json=codes | {"exact": True})  # may too, or be refused
            animation = client.post(f"{path}/interpolations", json={"keyframes": codes["latents"][:2], "frames": 2})
            client.get(animation.raise_for_status().json()["links"]["usd"]).raise_for_status()
        mesh = client.get("/v1/models/small/mesh?format=obj").raise_for_status().content
        client.post("/v1/models/small/encode?format=obj", content=mesh).raise_for_status()


@contextlib.contextmanager
def serving(deadline: float = DEADLINE, **settings: object) -> Iterator[CostTrial]:
    """A server with the bundled models and two small ones."""
    with TemporaryDirectory() as folder:
        models = Path(folder, "models")
        shutil.copytree(ROOT / "models", models)
        write_bundle(models, "small")
        write_bundle(models, "with-fine", fine=True)

        def start() -> Measured:
            server = Measured(models, deadline, workers=2, **settings)
            warm_up(server.url)
            return server

        trial = CostTrial(start)
        try:
            yield trial
        finally:
            trial.server.kill()


def summary(costs: Sequence[Cost], most: int = 20) -> str:
    """The number of requests over a budget, and a Markdown table of the most expensive ones."""
    rows = [
        f"{len(costs)} requests, {sum(bool(cost.over) for cost in costs)} of them over a budget; the worst:",
        "",
        "| request | seed | sent | loop, ms | stall, ms | collecting, ms | MiB | s | CPU s | status | what is over |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for cost in sorted(costs, key=lambda cost: -cost.badness)[:most]:
        times = " | ".join(f"{1e3 * seconds:.0f}" for seconds in (cost.loop, cost.stall, cost.collecting))
        statuses = " ".join(map(str, sorted(set(cost.statuses)))) or "—"
        rows.append(
            f"| {cost.name}: `{cost.line}` | {cost.seed} | {cost.sent:,} | {times} | {cost.memory / MIB:.0f} "
            f"| {cost.seconds:.2f} | {cost.computing:.2f} | {statuses} | {'; '.join(cost.over) or '—'} |"
        )
    return "\n".join(rows)
