"""Child process of a sandbox: an interpreter that runs one task after another until its parent ends.

It imports little except what a task needs, because the memory limit counts from the memory before the task.
"""

from __future__ import annotations

import importlib
import os
import resource
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path

from shapespace.service.limits.process_memory import mapped_size, resident_size, trim_heap, tune_malloc
from shapespace.service.limits.sandbox_messages import (
    LONGEST_SENTENCE,
    PIECE,
    Arrays,
    FailedError,
    JsonObject,
    in_a_line,
    receive,
    send,
)
from shapespace.service.refusals import RefusedError

#: A function ``(body, **facts)`` that returns facts and arrays.
Task = Callable[..., tuple[JsonObject, Arrays]]
#: A child that uses this many bytes more than at its start answers no further call.
GROWTH = 128 * 2**20


def main(connection: Connection, path: str) -> None:
    """Serve the calls of the parent until the parent ends."""
    # Ctrl-C in a terminal, or a signal to the process group, reaches the children too. Only the parent may end them.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, args=[connection], daemon=True).start()
    tune_malloc()
    with suppress(OSError):  # when memory runs out, the system kills this process before the server
        Path("/proc/self/oom_score_adj").write_text("1000")
    for limit in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE):
        resource.setrlimit(limit, (0, 0))
    with suppress(Exception):  # the first call raises the error
        _function(path)
    before = resident_size()
    with suppress(EOFError, ConnectionError):
        while True:
            reply, arrays = _outcome(connection, path)
            trim_heap()
            send(connection, reply | {"full": resident_size() - before > GROWTH}, arrays)


def _exit_with_parent(connection: Connection) -> None:
    """End this process when its parent ends, even in the middle of a task."""
    poll = select.poll()
    poll.register(connection, 0)  # no event but the end of the connection
    poll.poll()
    os._exit(1)


def _outcome(connection: Connection, path: str) -> tuple[JsonObject, Arrays]:
    """Run the task of the next call; return the reply and its arrays."""
    request, _ = receive(connection)
    bodies = [bytearray()]
    while len(bodies[0]) < request["body"]:
        bodies[0] += connection.recv_bytes(PIECE)
    try:
        task = _function(path)
        with _limited(request["memory"]):
            facts, arrays = task(bodies.pop(), **request["facts"])  # no reference stays, so that the task can free it
            return {"facts": facts}, arrays
    except MemoryError:
        return {"error": "memory"}, {}
    except RefusedError as error:
        return {"error": error.kind, "sentence": str(error)[:LONGEST_SENTENCE]}, {}
    except Exception as error:
        return {"error": FailedError.UNEXPECTED, "sentence": in_a_line(error)[:LONGEST_SENTENCE]}, {}


def _function(path: str) -> Task:
    module, name = path.split(":")
    function: Task = getattr(importlib.import_module(module), name)
    return function


def raise_memory_limit(memory: int) -> None:
    """Allow the running task ``memory`` more bytes than its caller did."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if soft != hard:
        more = soft + memory
        resource.setrlimit(resource.RLIMIT_AS, (more if hard == resource.RLIM_INFINITY else min(more, hard), hard))


@contextmanager
def _limited(memory: int) -> Iterator[None]:
    """Limit the memory that is mapped in addition to the present memory."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    if now := mapped_size():
        lowest = min(n for n in (now + memory, *before) if n != resource.RLIM_INFINITY)
        resource.setrlimit(resource.RLIMIT_AS, (lowest, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


if __name__ == "__main__":
    main(Connection(int(sys.argv[1])), sys.argv[2])
