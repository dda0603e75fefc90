"""Observing a server from outside: waiting for a condition, and reading metrics."""

import contextlib
import secrets
import socket
import time
from collections.abc import Callable
from pathlib import Path

import httpx
from prometheus_client.parser import text_string_to_metric_families

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


#: Seconds in which a server ends after its drain, and in which it has ended on a busy machine too.
ENDING, SOON = 3, 40


def eventually(holds: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "the condition did not become true in time"
        time.sleep(0.02)


def free_port() -> int:
    """A port on which nobody listens, below those that systems give to connections and to servers of other tests."""
    while True:
        with contextlib.suppress(OSError), socket.socket() as free:
            free.bind(("127.0.0.1", 2**14 + secrets.randbelow(2**14)))
            return int(free.getsockname()[1])


def children_of(pid: int | str) -> list[int]:
    """Ids of a process's children, zombies included; none if it has ended."""
    found = []
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    return found


def processes(pid: int) -> list[int]:
    """Ids of a process and of all processes that it has started, parents first."""
    found = [pid]
    for each in found:
        found += children_of(each)
    return found


def samples(client: httpx.Client) -> Samples:
    """The samples of ``/metrics``, a call that takes no place in the queue."""
    text = client.get("/metrics").raise_for_status().text
    families = text_string_to_metric_families(text)
    return {(s.name, frozenset(s.labels.items())): s.value for family in families for s in family.samples}


def value(found: Samples, name: str, **labels: str) -> float:
    return found.get((name, frozenset(labels.items())), 0)


def admitted(client: httpx.Client) -> float:
    """Number of requests running or waiting."""
    return samples(client)["shapespace_admitted", frozenset()]
