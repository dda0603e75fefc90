"""Child processes for untrusted data, with limits of memory and time.

This is the only defence against hostile uploads and bundles. The readers of files have no limits of their own except
on the size of the mesh, which they need for their messages. Limits in the readers were the alternative. The process is
better for three reasons. ONNX Runtime, which runs the networks of a bundle, has no such limits, so that the process is
needed in any case. Only a process also stops a reader that is slow, hangs or crashes. And a limit of the kernel holds
for every line of every reader, while a reader has to count at each of its allocations.

A child is a fresh interpreter, not a fork of the server. The server sends it the name of a function, arguments as JSON
and a body as bytes. The child answers with JSON and arrays, at most as many bytes as the caller allows. If a file
breaks the child, the caller gets an error in one sentence, and the next call a new child. Pools of processes, as those
of ``concurrent.futures`` and Pebble, unpickle what a child answers, so that a hostile file could go on in the server.

A child has none of the server's settings, can't write files, and ends when the server ends, in whatever way.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

from shapespace.files.limits import in_words
from shapespace.service.limits.sandbox_errors import (
    ClosedError,
    DiedError,
    FailedError,
    LateError,
    NoProcessError,
    OutOfMemoryError,
    SandboxError,
)
from shapespace.service.limits.sandbox_wire import (
    LONGEST_SENTENCE,
    Arrays,
    JsonObject,
    receive,
    receive_arrays,
    send,
)
from shapespace.solve.deadline import Deadline

#: Tasks by name: functions ``(body: bytearray, **facts) -> (facts, arrays)`` that raise FailedError for bad input.
#: They are strings, because only children import these modules, which belong to a layer above this one.
TASKS = {
    # Load a bundle that is to be served, and run its networks once.
    "validate": "shapespace.service.repository.validation_task:validate_bundle",
    # Read an uploaded mesh file.
    "read": "shapespace.service.use_cases.uploads:read_in_sandbox",
}
#: Parts of a body that haven't been sent to the child yet.
Pieces = deque[memoryview]

#: A child is replaced when it uses this many bytes more than at its start.
GROWTH = 128 * 2**20
#: Seconds between two checks of the deadline. A cancelled request moves its deadline to now.
_CHECK_INTERVAL = 0.2
#: Seconds in which a child has to exit after it has closed its connection.
_EXIT_TIME = 5.0


class Sandbox:
    """A pool of at most so many child processes, which start when they are needed.

    Any number of threads can call it. A call waits until a child is free.
    """

    def __init__(self, processes: int) -> None:
        self._free = threading.BoundedSemaphore(processes)
        self._lock = threading.Lock()
        self._idle: list[_Child] = []
        self._busy: set[_Child] = set()
        self._closed = False

    def prepare(self, task: str) -> None:
        """Start a child that imports the modules of a task, unless a child is idle. Doesn't wait for it."""
        with self._lock, suppress(OSError):  # the next call raises the error
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
    ) -> tuple[JsonObject, Arrays]:
        """Run a task in a child and return its result.

        Args:
            task: name of one of TASKS.
            facts: arguments of the task; JSON must be able to represent them.
            body: data for the task. It is emptied while it is sent, so that it is never in both processes in full.
            deadline: time at which the child is killed.
            memory: bytes that the task may map in addition to the body. Linux enforces this; other systems may not.
            most: largest number of bytes of arrays in the result.

        Raises:
            SandboxError: one of those of `sandbox_errors`, as the cause is.
        """
        if not self._free.acquire(timeout=max(0.0, deadline.time - time.monotonic())):
            raise LateError("every process was busy until the deadline")
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
        """Kill every child; running calls raise ClosedError."""
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
            for child in self._busy:
                child.kill()  # the thread that called it cleans up
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
                raise NoProcessError(f"no process can be started: {in_words(error)}") from None
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
    """One process, which begins by importing a function, and the connection to it, for one thread at a time."""

    def __init__(self, path: str) -> None:
        hidden = {name for name in os.environ if name.startswith("SHAPESPACE_")}
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        # The child imports the same modules as this process. Its libraries use one thread each, as in the server.
        own, paths = str(Path(__file__).parents[3]), [path for path in sys.path if path]
        environment["PYTHONPATH"] = os.pathsep.join(paths if own in paths else [own, *paths])
        environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        self._connection, theirs = Pipe()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - the arguments are this interpreter, a number and a name of TASKS
                [sys.executable, "-P", "-m", "shapespace.service.limits.sandbox_child", str(theirs.fileno()), path],
                env=environment,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Libraries print parts of the uploaded file to it.
                stderr=subprocess.DEVNULL,
            )
        except OSError:
            self._connection.close()
            raise
        finally:
            theirs.close()
        self._memory_at_start: int | None = None
        self._memory = 0

    @property
    def dead(self) -> bool:
        """Whether the process has ended, as where the system kills it when memory runs out."""
        return self._process.poll() is not None

    @property
    def grown(self) -> bool:
        """Whether the process uses much more memory than at its start."""
        return self._memory - (self._memory_at_start or 0) > GROWTH

    def call(
        self, path: str, facts: Mapping[str, Any], body: Pieces | None, deadline: Deadline, memory: int, most: int
    ) -> tuple[JsonObject, Arrays]:
        """Run a task, as `Sandbox.call`. After an exception other than FailedError the child can't be used again."""
        with self._killed_by(deadline), self._as_sandbox_errors(deadline):
            if self._memory_at_start is None:
                self._memory_at_start = int(receive(self._connection)["memory"])
            length = sum(map(len, body)) if body else 0
            seconds = math.ceil(deadline.time - time.monotonic())
            request = {"task": path, "facts": facts, "body": length, "memory": memory, "seconds": seconds}
            send(self._connection, request, _taken_from(body or Pieces()))
            reply = receive(self._connection)
            self._memory = int(reply["memory"])
            _raise(reply)
            return dict(reply["facts"]), receive_arrays(self._connection, reply["arrays"], most)

    @contextmanager
    def _killed_by(self, deadline: Deadline) -> Iterator[None]:
        """Kill the process when the deadline passes, so that nothing waits for it any longer."""
        done = threading.Event()

        def watch() -> None:
            while not done.wait(_CHECK_INTERVAL):
                if deadline.passed:
                    self.kill()
                    return

        threading.Thread(target=watch, daemon=True).start()
        try:
            yield
        finally:
            done.set()

    @contextmanager
    def _as_sandbox_errors(self, deadline: Deadline) -> Iterator[None]:
        """Raise errors of the connection as SandboxError."""
        seconds = deadline.time - time.monotonic()
        try:
            yield
        except (OSError, EOFError) as error:
            if deadline.passed:
                raise LateError(f"it took longer than {max(round(seconds, 1), 0):g} s") from None
            if str(error) == "bad message length":
                raise DiedError("its answer can't be read") from None
            raise self._exit_error() from None
        except (ValueError, TypeError, LookupError, RecursionError):
            raise DiedError("its answer can't be read") from None

    def _exit_error(self) -> SandboxError:
        try:
            status = self._process.wait(_EXIT_TIME)
        except subprocess.TimeoutExpired:
            return DiedError("it closed the connection")
        if status >= 0:
            return DiedError(f"it ended with status {status}")
        name = signal.Signals(-status).name
        if name == "SIGXCPU":
            return LateError("it took more processor time than allowed")
        if name == "SIGKILL":
            return OutOfMemoryError("the system killed it, probably because memory ran out")
        return DiedError(f"it died of {name}")

    def kill(self) -> None:
        """Kill the process; its caller gets an error."""
        self._process.kill()

    def end(self) -> None:
        """Kill the process and release its resources."""
        self.kill()
        self._process.wait()
        self._connection.close()


def _taken_from(body: Pieces) -> Iterator[memoryview]:
    while body:
        yield body.popleft()


def _raise(reply: Mapping[str, Any]) -> None:
    match reply.get("error"):
        case None:
            return
        case "memory":
            raise OutOfMemoryError("it needs more memory than allowed")
        case error:
            raise FailedError(str(error), str(reply["sentence"])[:LONGEST_SENTENCE])
