"""Bars for whoever waits: nothing in the first seconds, then how far it is and how long it takes."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from tqdm import tqdm

#: Seconds of silence; and between two lines where no terminal rewrites them.
DELAY, PAUSE = 5, 10

Item = TypeVar("Item")


class _Lines(tqdm):
    """A bar for files and pipes: a line now and then."""

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        if msg is None:
            print(self, file=sys.stderr, flush=True)  # noqa: T201 - what a bar is for
        return True


def bar(title: str, unit: str = "it", total: int | None = None, items: Iterable[Any] | None = None, **how: Any) -> tqdm:
    """A bar of tqdm's on the standard error, that is gone at the end."""
    terminal = sys.stderr.isatty()
    kind, pause = (tqdm, 0.1) if terminal else (_Lines, PAUSE)
    return kind(items, desc=title, unit=unit, total=total, delay=DELAY, mininterval=pause, leave=False, **how)


def progress(items: Iterable[Item], title: str, unit: str = "it", total: int | None = None) -> Iterator[Item]:
    """The items, counted by a bar."""
    yield from bar(title, unit, total, items)


@contextmanager
def waiting(title: str) -> Iterator[None]:
    """A bar that only counts seconds, for work that can't say how far it is."""
    over = threading.Event()

    def tick() -> None:
        with bar(title, "s", bar_format="{desc}: {elapsed}") as seconds:
            while not over.wait(1):
                seconds.update()

    clock = threading.Thread(target=tick, daemon=True)
    clock.start()
    try:
        yield
    finally:
        over.set()
        clock.join()
