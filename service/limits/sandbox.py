"""Child processes for untrusted data, with limits of memory and time.

This is the only defence against hostile uploads and bundles: the readers of files limit nothing but the size of the
mesh. A limit of the kernel holds for every line of every reader and of ONNX Runtime, and only a process can be stopped
that is slow, hangs or crashes.

A child is a fresh interpreter, not a fork of the server. It imports one function, and the server sends arguments as
JSON and a body as bytes. The child answers with JSON and arrays, at most as many bytes as the caller allows. If a file
breaks the child, the caller gets an error in one sentence, and the next call a new child. Pools of processes, as those
of ``concurrent.futures`` and Pebble, unpickle what a child answers, so that a hostile file could go on in the server.

A child has none of the server's settings, can't write files, and ends when the server ends, in whatever way.
"""

from __future__ import annotations

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
from queue import Empty, LifoQueue
from typing import Any

from shapespace.files.limits import in_words
from shapespace.service.limits.sandbox_messages import (
    LONGEST_SENTENCE,
    PIECE,
    Arrays,
    ClosedError,
    DiedError,
    FailedError,
    JsonObject,
    LateError,
    NoProcessError,
    OutOfMemoryError,
    SandboxError,
    receive,
    send,
)
from shapespace.solve.deadline import Deadline

# Tasks: functions ``(body: bytearray, **facts) -> (facts, arrays)`` that raise RefusedError for bad input. They are
# strings, because only children import these modules, which belong to a layer above this one.

#: Load a bundle that is to be served, and run its networks once.
VALIDATE = "shapespace.service.repository.validation_task:validate_bundle"
#: Read an uploaded mesh file.
READ = "shapespace.service.use_cases.uploads:read_in_sandbox"
#: Parts of a body that haven't been sent to the child yet.
Pieces = deque[memoryview]

#: Seconds between two checks of the deadline. A cancelled request moves its deadline to now.
_CHECK_INTERVAL = 0.2
#: Seconds in which a child has to exit after it has closed its connection.
_EXIT_TIME = 5.0
_UNREADABLE = DiedError("its answer can't be read")


class Sandbox:
    """A limited number of child processes for one task, which start when they are needed.

    Any number of threads can call it. A call waits until a child is free.
    """

    def __init__(self, processes: int, task: str) -> None:
        self._task, self._closed, self._lock = task, False, threading.Lock()
        self._children: set[_Child] = set()
        #: Children that are free, and None for each that isn't started. The last one is the next that works.
        self._free = LifoQueue[_Child | None]()
        for _ in range(processes):
            self._free.put(None)

    def prepare(self) -> None:
        """Start a child that imports the task, unless a child is free. Doesn't wait for it."""
        with suppress(SandboxError, Empty):  # the next call raises the error
            child = self._free.get_nowait()
            try:
                child = child or self._start()
            finally:
                self._free.put(child)

    def call(
        self,
        facts: Mapping[str, Any] | None = None,
        body: Pieces | None = None,
        *,
        deadline: Deadline,
        memory: int,
        most: int = 0,
    ) -> tuple[JsonObject, Arrays]:
        """Run the task in a child and return its result.

        Args:
            facts: arguments of the task; JSON must be able to represent them.
            body: data for the task. It is emptied while it is sent, so that it is never in both processes in full.
            deadline: time at which the child is killed.
            memory: bytes that the task may map in addition to the body. Linux enforces this; other systems may not.
            most: largest number of bytes of arrays in the result.

        Raises:
            SandboxError: one of those of `sandbox_messages`, as the cause is.
        """
        try:
            child = self._free.get(timeout=max(0.0, deadline.time - time.monotonic()))
        except Empty:
            raise LateError("every process was busy until the deadline") from None
        try:
            if child is None or child.dead:
                self._end(child)
                child = self._start()
            outcome, arrays, full = child.call(facts or {}, body or Pieces(), deadline, memory, most)
        except BaseException as error:
            self._end(child)
            self._free.put(None)
            if self._closed and isinstance(error, SandboxError):
                raise ClosedError("the sandbox is closed") from None
            self.prepare()
            raise
        if full:
            self._end(child)
        self._free.put(None if full else child)
        if isinstance(outcome, SandboxError):
            raise outcome
        return outcome, arrays

    def close(self) -> None:
        """Kill every child; running calls raise ClosedError."""
        with self._lock:
            self._closed = True
        for child in tuple(self._children):
            self._end(child)

    def __enter__(self) -> Sandbox:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> _Child:
        with self._lock:
            if self._closed:
                raise ClosedError("the sandbox is closed")
            try:
                child = _Child(self._task)
            except OSError as error:
                raise NoProcessError(f"no process can be started: {in_words(error)}") from None
            self._children.add(child)
            return child

    def _end(self, child: _Child | None) -> None:
        if child:
            child.end()
            self._children.discard(child)


class _Child:
    """One process, which imports a task, and the connection to it, for one thread at a time."""

    def __init__(self, task: str) -> None:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("SHAPESPACE_")}
        # The child imports the same modules as this process. Its libraries use one thread each, as in the server.
        own, paths = str(Path(__file__).parents[3]), [path for path in sys.path if path]
        environment["PYTHONPATH"] = os.pathsep.join(paths if own in paths else [own, *paths])
        environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        self._connection, theirs = Pipe()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 - the arguments are this interpreter, a number and a task
                [sys.executable, "-P", "-m", "shapespace.service.limits.sandbox_child", str(theirs.fileno()), task],
                env=environment,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Libraries print parts of the uploaded file to it.
                stderr=subprocess.DEVNULL,
            )

    @property
    def dead(self) -> bool:
        """Whether the process has ended, as where the system kills it when memory runs out."""
        return self._process.poll() is not None

    def call(
        self, facts: Mapping[str, Any], body: Pieces, deadline: Deadline, memory: int, most: int
    ) -> tuple[JsonObject | SandboxError, Arrays, bool]:
        """Return the facts that answer a call, or the fault that the task reports, its arrays, and whether the child
        is full. After an exception the child can't be used again.
        """
        began = time.monotonic()
        try:
            with self._killed_by(deadline):
                send(self._connection, {"facts": facts, "body": sum(map(len, body)), "memory": memory})
                while body:
                    piece = body.popleft()
                    for start in range(0, len(piece), PIECE):
                        self._connection.send_bytes(piece[start : start + PIECE])
                reply, arrays = receive(self._connection, most)
                return _outcome(reply), arrays, bool(reply["full"])
        except (OSError, EOFError) as error:
            if deadline.passed:
                raise LateError(f"it took longer than {max(round(deadline.time - began, 1), 0):g} s") from None
            raise (_UNREADABLE if str(error) == "bad message length" else self._exit_error()) from None
        except (ValueError, TypeError, LookupError, RecursionError, MemoryError):
            raise _UNREADABLE from None

    @contextmanager
    def _killed_by(self, deadline: Deadline) -> Iterator[None]:
        """Kill the process when the deadline passes, so that nothing waits for it any longer."""
        done = threading.Event()

        def watch() -> None:
            while not done.wait(_CHECK_INTERVAL):
                if deadline.passed:
                    self._process.kill()
                    return

        threading.Thread(target=watch, daemon=True).start()
        try:
            yield
        finally:
            done.set()

    def _exit_error(self) -> SandboxError:
        try:
            status = self._process.wait(_EXIT_TIME)
        except subprocess.TimeoutExpired:
            return DiedError("it closed the connection")
        if status == -signal.SIGKILL:
            return OutOfMemoryError("the system killed it, probably because memory ran out")
        return DiedError(
            f"it died of {signal.Signals(-status).name}" if status < 0 else f"it ended with status {status}"
        )

    def end(self) -> None:
        """Kill the process; a call that runs gets an error."""
        self._process.kill()
        self._process.wait()


def _outcome(reply: Mapping[str, Any]) -> JsonObject | SandboxError:
    match reply.get("error"):
        case None:
            return dict(reply["facts"])
        case "memory":
            return OutOfMemoryError("it needs more memory than allowed")
        case error:
            return FailedError(str(error), str(reply["sentence"])[:LONGEST_SENTENCE])
