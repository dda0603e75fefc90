"""Work on what strangers wrote, in processes of its own: with a limit of memory, and ended where it takes too long.

A child is a fresh interpreter and no fork of the server. It is sent the name of a function, its arguments as JSON and
a body as bytes; back come JSON and arrays, no longer than the caller expects, and never a pickle. What is wrong with a
file may break the child: the caller then gets a sentence, and the next call another child.

The children see none of the server's settings, write no file, and end with the server, however that ends.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import resource
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shapespace.service.limits.process_memory import mapped_size, resident_size, trim_heap, tune_malloc
from shapespace.solve.deadline import Deadline

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: What children can do, by name: functions ``(body: bytearray, **facts) -> (facts, arrays)``. What they find wrong they
#: say by FailedError. Names and no imports: only the children that need a module import it, and it is of a layer above.
TASKS = {
    # A bundle that is to be served, loaded and run once.
    "validate": "shapespace.service.repository.validation_task:validate_bundle",
    # A mesh file that somebody has sent.
    "read": "shapespace.service.use_cases.uploads:read_in_sandbox",
}
Facts = dict[str, Any]
Arrays = dict[str, "NDArray[Any]"]
Task = Callable[..., tuple[Facts, Arrays]]
#: A body on its way.
Pieces = deque[memoryview]
#: Waits until a connection is ready for an event of ``select.poll``.
Wait = Callable[[int], None]

#: Bytes of JSON in one message, and characters of a sentence in it.
LONGEST_MESSAGE, LONGEST_SENTENCE = 2**20, 1000
#: A child that keeps so much more than it began with is replaced.
GROWTH = 128 * 2**20
_LENGTH = struct.Struct("!I")
_PIECE = 2**20
_DTYPE = re.compile(r"[<|>][fiub][1248]")
#: Milliseconds between looks at the deadline, which may be called off.
_LOOK = 200
#: Seconds for a child to be gone that has closed its connection.
_END = 5.0


class SandboxError(Exception):
    """A call without an answer."""


class LateError(SandboxError):
    """The deadline passed, and the child was ended."""


class OutOfMemoryError(SandboxError):
    """The task needs more memory than it may have."""


class NoProcessError(SandboxError):
    """The system gives no process."""


class DiedError(SandboxError):
    """The child died of what it was given."""


class ClosedError(SandboxError):
    """Nothing is done here any more."""


class FailedError(SandboxError):
    """What a task itself found wrong; raised by the task, and again where it was called.

    Attributes:
        kind: of fault, in a word; UNEXPECTED for an exception that the task was not prepared for.
        sentence: for people.
    """

    UNEXPECTED = "unexpected"

    def __init__(self, kind: str, sentence: str) -> None:
        super().__init__(sentence)
        self.kind, self.sentence = kind, sentence


class Sandbox:
    """A few children, made when they are needed and used again and again.

    For any number of threads: who calls waits until a child is free.

    Args:
        processes: children at once.
    """

    def __init__(self, processes: int) -> None:
        self._free = threading.BoundedSemaphore(processes)
        self._lock = threading.Lock()
        self._idle: list[_Child] = []
        self._busy: set[_Child] = set()
        self._closed = False

    def prepare(self, task: str) -> None:
        """Make a child, unless one is idle, and have it import what a task needs; doesn't wait for it."""
        with self._lock, suppress(OSError):  # a call will say what is the matter
            if not (self._idle or self._closed):
                self._idle.append(_Child(TASKS[task]))

    def call(
        self,
        task: str,
        facts: Mapping[str, Any] | None = None,
        body: Pieces | None = None,
        *,
        deadline: Deadline,
        memory: int,
        most: int = 0,
    ) -> tuple[Facts, Arrays]:
        """Run a task in a child, and wait for what it says.

        Args:
            task: one of TASKS.
            facts: its arguments, as JSON has them.
            body: sent piece by piece, and emptied meanwhile, so that it is never here and there in full.
            deadline: after which the child is ended.
            memory: bytes that the task may map beside the body. Kept on Linux, elsewhere as the system likes.
            most: bytes of arrays that may come back.

        Raises:
            LateError, OutOfMemoryError, NoProcessError, DiedError, FailedError: by which the call came to nothing.
            ClosedError: the sandbox is closed, or was meanwhile.
        """
        if not self._free.acquire(timeout=max(0.0, deadline.time - time.monotonic())):
            raise LateError("every process was at work until the time was over")
        try:
            child = self._take(task)
            try:
                answer = child.call(TASKS[task], facts or {}, body, deadline, memory, most)
            except FailedError:
                self._put(child, task)
                raise
            except BaseException as error:
                self._replace(child, task)
                if self._closed and isinstance(error, SandboxError):
                    raise ClosedError("the sandbox was closed") from None
                raise
            self._put(child, task)
            return answer
        finally:
            self._free.release()

    def close(self) -> None:
        """End every child at once; calls that still run raise ClosedError."""
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
            for child in self._busy:
                child.kill()  # and its caller does the rest
        for child in idle:
            child.end()

    def __enter__(self) -> Sandbox:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take(self, task: str) -> _Child:
        with self._lock:
            if self._closed:
                raise ClosedError("the sandbox is closed")
            while self._idle and self._idle[-1].dead:
                self._idle.pop().end()
            try:
                child = self._idle.pop() if self._idle else _Child(TASKS[task])
            except OSError as error:
                raise NoProcessError(f"no process can be started: {error}") from None
            self._busy.add(child)
            return child

    def _put(self, child: _Child, task: str) -> None:
        if child.grown:
            self._replace(child, task)
            return
        with self._lock:
            self._busy.remove(child)
            if not self._closed:
                self._idle.append(child)
                return
        child.end()

    def _replace(self, child: _Child, task: str) -> None:
        with self._lock:
            self._busy.remove(child)
        child.end()
        self.prepare(task)


class _Child:
    """One process and the connection to it; for one thread at a time.

    Args:
        path: what it should import at once.
    """

    def __init__(self, path: str) -> None:
        hidden = {name for name in os.environ if name.startswith("SHAPESPACE_")}
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        # What runs here runs there; and one thread each, as everywhere.
        own, paths = str(Path(__file__).parents[3]), [path for path in sys.path if path]
        environment["PYTHONPATH"] = os.pathsep.join(paths if own in paths else [own, *paths])
        environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        self._connection, theirs = socket.socketpair()
        self._connection.setblocking(False)
        try:
            self._process = subprocess.Popen(  # noqa: S603 - this interpreter, and a number
                [sys.executable, "-P", "-m", "shapespace.service.limits.sandbox", str(theirs.fileno()), path],
                env=environment,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Libraries quote there what they read.
                stderr=subprocess.DEVNULL,
            )
        except OSError:
            self._connection.close()
            raise
        finally:
            theirs.close()
        self._begun: int | None = None
        self._now = 0

    @property
    def dead(self) -> bool:
        """Whether something has ended it, as the system does where memory runs out."""
        return self._process.poll() is not None

    @property
    def grown(self) -> bool:
        """Whether it keeps much more memory than it began with."""
        return self._now - (self._begun or 0) > GROWTH

    def call(
        self,
        path: str,
        facts: Mapping[str, Any],
        body: Pieces | None,
        deadline: Deadline,
        memory: int,
        most: int,
    ) -> tuple[Facts, Arrays]:
        """As Sandbox.call; after any exception but FailedError the child is of no use any more."""

        def wait(event: int) -> None:
            poll = select.poll()
            poll.register(self._connection, event)
            while not deadline.passed:
                if poll.poll(_LOOK):
                    return
            raise TimeoutError

        with self._told(deadline):
            if self._begun is None:
                self._begun = int(_receive(self._connection, wait)["memory"])
            length = sum(map(len, body)) if body else 0
            seconds = math.ceil(deadline.time - time.monotonic())
            request = {"task": path, "facts": facts, "body": length, "memory": memory, "seconds": seconds}
            _send(self._connection, request, wait)
            while body:
                _send_all(self._connection, body.popleft(), wait)
            reply = _receive(self._connection, wait)
            self._now = int(reply["memory"])
            _raise(reply)
            return dict(reply["facts"]), _receive_arrays(self._connection, reply["arrays"], most, wait)

    @contextmanager
    def _told(self, deadline: Deadline) -> Iterator[None]:
        """What goes wrong between the two processes, as a SandboxError."""
        seconds = deadline.time - time.monotonic()
        try:
            yield
        except TimeoutError:
            raise LateError(f"it took longer than {max(round(seconds, 1), 0):g} s") from None
        except (OSError, EOFError):
            raise self._death() from None
        except (ValueError, TypeError, LookupError, RecursionError):
            raise DiedError("it answered what can't be read") from None

    def _death(self) -> SandboxError:
        try:
            status = self._process.wait(_END)
        except subprocess.TimeoutExpired:
            return DiedError("it closed the connection")
        if status >= 0:
            return DiedError(f"it ended with status {status}")
        name = signal.Signals(-status).name
        if name == "SIGXCPU":
            return LateError("it took more of the processor's time than there was")
        if name == "SIGKILL":
            return OutOfMemoryError("the system killed it, as it does where memory runs out")
        return DiedError(f"it died of {name}")

    def kill(self) -> None:
        """End it, whatever it does, for its caller to see."""
        self._process.kill()

    def end(self) -> None:
        """End it, whatever it does, and leave nothing of it behind."""
        self._process.kill()
        self._process.wait()
        self._connection.close()


def _blocks(_: int) -> None:
    """What children wait for is the connection itself."""


def _send(connection: socket.socket, message: Mapping[str, Any], wait: Wait = _blocks) -> None:
    data = json.dumps(message).encode()
    _send_all(connection, _LENGTH.pack(len(data)) + data, wait)


def _send_all(connection: socket.socket, data: bytes | bytearray | memoryview, wait: Wait) -> None:
    rest = memoryview(data)
    while rest:
        wait(select.POLLOUT)
        with suppress(BlockingIOError):
            rest = rest[connection.send(rest[:_PIECE]) :]


def _receive(connection: socket.socket, wait: Wait = _blocks) -> dict[str, Any]:
    """The next message; raises EOFError, and ValueError for what is none."""
    (length,) = _LENGTH.unpack(_receive_exactly(connection, _LENGTH.size, wait))
    if length > LONGEST_MESSAGE:
        raise ValueError
    message = json.loads(_receive_exactly(connection, length, wait))
    if not isinstance(message, dict):
        raise ValueError
    return message


def _receive_exactly(connection: socket.socket, length: int, wait: Wait = _blocks) -> bytearray:
    # By pieces: what hasn't come yet takes no memory.
    data = bytearray()
    while len(data) < length:
        wait(select.POLLIN)
        piece = connection.recv(min(length - len(data), _PIECE))
        if not piece:
            raise EOFError
        data += piece
    return data


def _raise(reply: Mapping[str, Any]) -> None:
    match reply.get("error"):
        case None:
            return
        case "memory":
            raise OutOfMemoryError("it takes more memory than it may have")
        case error:
            raise FailedError(str(error), str(reply["sentence"])[:LONGEST_SENTENCE])


def _receive_arrays(connection: socket.socket, described: Any, most: int, wait: Wait) -> Arrays:
    import numpy as np

    arrays = {}
    for name, dtype, shape in described:
        if not _DTYPE.fullmatch(dtype) or not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError
        length = math.prod(shape) * np.dtype(dtype).itemsize
        most -= length
        if most < 0:
            raise ValueError
        arrays[str(name)] = np.frombuffer(_receive_exactly(connection, length, wait), dtype).reshape(shape)
    return arrays


# What follows runs in the children.


def main() -> None:
    """Serve the parent's calls until it is gone."""
    connection = socket.socket(fileno=int(sys.argv[1]))
    # A terminal, or whoever ends a whole group, sends signals to the children as well: the parent decides.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=[connection], daemon=True).start()
    tune_malloc()
    with suppress(OSError):  # where memory runs out, this process goes before the server
        Path("/proc/self/oom_score_adj").write_text("1000")
    for limit in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE):
        resource.setrlimit(limit, (0, 0))
    with suppress(Exception):  # a call will say what is the matter
        _function(sys.argv[2])
    _send(connection, {"memory": resident_size()})
    with suppress(EOFError, ConnectionError):
        while True:
            _serve(connection, _receive(connection))


def _end_with(connection: socket.socket) -> None:
    """End this process when its parent is gone, whatever it does at that moment."""
    poll = select.poll()
    poll.register(connection, 0)  # nothing but the other side's end
    poll.poll()
    os._exit(1)


def _serve(connection: socket.socket, request: Mapping[str, Any]) -> None:
    bodies = [_receive_exactly(connection, request["body"])]

    def run() -> tuple[Facts, Arrays]:
        task = _function(request["task"])
        with _limited(request["memory"], request["seconds"]):
            return task(bodies.pop(), **request["facts"])  # and nobody keeps it longer

    reply, arrays = _outcome(run)
    trim_heap()
    described = [(name, array.dtype.str, array.shape) for name, array in arrays.items()]
    _send(connection, reply | {"arrays": described, "memory": resident_size()})
    for array in arrays.values():
        connection.sendall(array.data.cast("B") if array.size else b"")


def _outcome(run: Callable[[], tuple[Facts, Arrays]]) -> tuple[Facts, Arrays]:
    """A reply, and the arrays that go with it."""
    try:
        facts, arrays = run()
        return {"facts": facts}, {name: _contiguous(array) for name, array in arrays.items()}
    except MemoryError:
        return {"error": "memory"}, {}
    except FailedError as error:
        return {"error": error.kind, "sentence": error.sentence[:LONGEST_SENTENCE]}, {}
    except Exception as error:
        return {"error": FailedError.UNEXPECTED, "sentence": in_a_line(error)[:LONGEST_SENTENCE]}, {}


def in_a_line(error: BaseException) -> str:
    """An exception that nobody expected, and where it was raised."""
    where = traceback.extract_tb(error.__traceback__)[-1:]
    places = "".join(f" ({Path(frame.filename).name}, line {frame.lineno})" for frame in where)
    return f"{type(error).__name__}: {' '.join(str(error).split())}{places}"


def _contiguous(array: NDArray[Any]) -> NDArray[Any]:
    import numpy as np

    return np.ascontiguousarray(array)


def _function(path: str) -> Task:
    module, name = path.split(":")
    function: Task = getattr(importlib.import_module(module), name)
    return function


def allow(memory: int) -> None:
    """For tasks that have learned what they need: so many bytes more than the caller said."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if soft != hard:
        more = soft + memory
        resource.setrlimit(resource.RLIMIT_AS, (more if hard == resource.RLIM_INFINITY else min(more, hard), hard))


@contextmanager
def _limited(memory: int, seconds: int) -> Iterator[None]:
    """Bound what is mapped beyond what is so now, and the processor's time, where the system knows such limits."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    limits = {resource.RLIMIT_CPU: math.ceil(usage.ru_utime + usage.ru_stime) + seconds + 1}
    if now := mapped_size():
        limits[resource.RLIMIT_AS] = now + memory
    before = {limit: resource.getrlimit(limit) for limit in limits}
    try:
        for limit, value in limits.items():
            lowest = min(n for n in (value, *before[limit]) if n != resource.RLIM_INFINITY)
            resource.setrlimit(limit, (lowest, before[limit][1]))
        yield
    finally:
        for limit, pair in before.items():
            resource.setrlimit(limit, pair)


if __name__ == "__main__":
    # Under its own name, by which tasks know its exceptions.
    importlib.import_module("shapespace.service.limits.sandbox").main()
