"""Work on what strangers wrote, in processes of its own: with a limit of memory, and ended where it takes too long.

A child is a fresh interpreter and no fork of the server. It is sent the name of a function, its arguments as JSON and
a body as bytes; back come JSON and arrays, no longer than the caller expects, and never a pickle. What is wrong with a
file may break the child: the caller then gets a sentence, and the next call another child.

The children see none of the server's settings, write no file, and end with the server, however that ends.
"""

from __future__ import annotations

import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

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
    Facts,
    receive,
    receive_arrays,
    send,
    send_all,
)
from shapespace.solve.deadline import Deadline

#: The tasks of children, by name: functions ``(body: bytearray, **facts) -> (facts, arrays)`` that raise FailedError
#: for bad input. Given as strings, because only children import these modules, which belong to a layer above this one.
TASKS = {
    # Load a bundle that is to be served, and run its networks once.
    "validate": "shapespace.service.repository.validation_task:validate_bundle",
    # Read an uploaded mesh file.
    "read": "shapespace.service.use_cases.uploads:read_in_sandbox",
}
#: The part of a body that hasn't been sent to the child yet.
Pieces = deque[memoryview]

#: A child is replaced once it holds this many bytes more than at its start.
GROWTH = 128 * 2**20
#: Milliseconds between two checks of the deadline, because a request may be cancelled.
_LOOK = 200
#: Seconds within which a child that has closed its connection has to end.
_END = 5.0


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
        # The same modules as in this process, and one thread for each library, as everywhere in the server.
        own, paths = str(Path(__file__).parents[3]), [path for path in sys.path if path]
        environment["PYTHONPATH"] = os.pathsep.join(paths if own in paths else [own, *paths])
        environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        self._connection, theirs = socket.socketpair()
        self._connection.setblocking(False)
        try:
            self._process = subprocess.Popen(  # noqa: S603 - this interpreter, and a number
                [sys.executable, "-P", "-m", "shapespace.service.limits.sandbox_child", str(theirs.fileno()), path],
                env=environment,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Libraries print parts of the uploaded file there.
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
                self._begun = int(receive(self._connection, wait)["memory"])
            length = sum(map(len, body)) if body else 0
            seconds = math.ceil(deadline.time - time.monotonic())
            request = {"task": path, "facts": facts, "body": length, "memory": memory, "seconds": seconds}
            send(self._connection, request, wait)
            while body:
                send_all(self._connection, body.popleft(), wait)
            reply = receive(self._connection, wait)
            self._now = int(reply["memory"])
            _raise(reply)
            return dict(reply["facts"]), receive_arrays(self._connection, reply["arrays"], most, wait)

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


def _raise(reply: Mapping[str, Any]) -> None:
    match reply.get("error"):
        case None:
            return
        case "memory":
            raise OutOfMemoryError("it takes more memory than it may have")
        case error:
            raise FailedError(str(error), str(reply["sentence"])[:LONGEST_SENTENCE])
