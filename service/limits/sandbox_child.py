"""Child process of a sandbox: an interpreter that runs one task after another until its parent ends.

It imports little except what a task needs, because the memory limit counts from the memory before the task.
"""

from __future__ import annotations

import importlib
import math
import os
import resource
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from shapespace.service.limits.process_memory import mapped_size, resident_size, trim_heap, tune_malloc
from shapespace.service.limits.sandbox_errors import FailedError, in_a_line
from shapespace.service.limits.sandbox_wire import (
    LONGEST_SENTENCE,
    Arrays,
    JsonObject,
    describe_arrays,
    receive,
    receive_exactly,
    send,
)

#: A function ``(body, **facts)`` that returns facts and arrays.
Task = Callable[..., tuple[JsonObject, Arrays]]


def main() -> None:
    """Serve the calls of the parent until the parent ends."""
    connection = Connection(int(sys.argv[1]))
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
        _function(sys.argv[2])
    send(connection, {"memory": resident_size()})
    with suppress(EOFError, ConnectionError):
        while True:
            _serve(connection, receive(connection))


def _exit_with_parent(connection: Connection) -> None:
    """End this process when its parent ends, even in the middle of a task."""
    poll = select.poll()
    poll.register(connection, 0)  # no event but the end of the connection
    poll.poll()
    os._exit(1)


def _serve(connection: Connection, request: Mapping[str, Any]) -> None:
    bodies = [receive_exactly(connection, request["body"])]

    def run() -> tuple[JsonObject, Arrays]:
        task = _function(request["task"])
        with _limited(request["memory"], request["seconds"]):
            return task(bodies.pop(), **request["facts"])  # no reference stays here, so that the task can free it

    reply, arrays = _outcome(run)
    trim_heap()
    parts = (array.reshape(-1).view("u1").data for array in arrays.values())
    send(connection, reply | {"arrays": describe_arrays(arrays), "memory": resident_size()}, parts)


def _outcome(run: Callable[[], tuple[JsonObject, Arrays]]) -> tuple[JsonObject, Arrays]:
    """Run a task; return the reply and the arrays that follow it."""
    try:
        facts, arrays = run()
        return {"facts": facts}, {
            name: array if array.flags.c_contiguous else array.copy() for name, array in arrays.items()
        }
    except MemoryError:
        return {"error": "memory"}, {}
    except FailedError as error:
        return {"error": error.kind, "sentence": error.sentence[:LONGEST_SENTENCE]}, {}
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
def _limited(memory: int, seconds: int) -> Iterator[None]:
    """Limit the memory that is mapped in addition to the present memory, and the CPU time."""
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
    main()
