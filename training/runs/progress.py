"""Progress bars: silent in the first seconds, then with an estimate of the remaining time."""

import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from tqdm import tqdm

#: Seconds before the first output.
DELAY = 5
#: Seconds between two outputs where there is no terminal.
PAUSE = 10

Item = TypeVar("Item")


class _Lines(tqdm):
    """A bar for files and pipes, which writes a new line for each update."""

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        if msg is None:
            print(self, file=sys.stderr, flush=True)  # noqa: T201 - a bar has to print
        return True


def bar(title: str, unit: str = "it", total: int | None = None, items: Iterable[Any] | None = None, **how: Any) -> tqdm:
    """Return a bar on standard error that is removed at the end."""
    terminal = sys.stderr.isatty()
    kind, pause = (tqdm, 0.1) if terminal else (_Lines, PAUSE)
    return kind(items, desc=title, unit=unit, total=total, delay=DELAY, mininterval=pause, leave=False, **how)


def progress(items: Iterable[Item], title: str, unit: str = "it", total: int | None = None) -> Iterator[Item]:
    """Yield the items while a bar counts them."""
    yield from bar(title, unit, total, items)


@contextmanager
def waiting(title: str) -> Iterator[None]:
    """Show the elapsed seconds during work whose progress is unknown."""
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
