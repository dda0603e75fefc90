"""Progress bars: silent in the first seconds, then with an estimate of the remaining time."""

import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

from tqdm import tqdm

#: Seconds before the first output.
DELAY = 5
#: Seconds between two outputs where there is no terminal.
PAUSE = 10

#: Typical share of each stage in the time of a run, in percent. Larger runs spend more of it on samples.
SHARES = {
    "ingest": 10,
    "mean": 6,
    "modes": 14,
    "factors": 0,
    "samples": 42,
    "networks": 15,
    "generalisation": 7,
    "evaluation": 5,
    "export": 1,
}
#: The same for straight lines, which need no samples.
STRAIGHT_SHARES = {
    "ingest": 5,
    "mean": 52,
    "modes": 1,
    "factors": 0,
    "samples": 0,
    "networks": 0,
    "generalisation": 12,
    "evaluation": 5,
    "export": 25,
}

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


def stage_place(name: str, seconds: Mapping[str, float], stages: Iterable[str], *, straight: bool = False) -> str:
    """Say which of the ``stages`` this one is, and about how long it and the later stages will take.

    The estimate comes from the ``seconds`` of the stages that are done and from `SHARES`, or `STRAIGHT_SHARES`. It is
    left out before any stage but the first has taken a second: the time to read files says little about the others.
    """
    shares = STRAIGHT_SHARES if straight else SHARES
    names = list(stages)
    k = names.index(name)
    words = f"stage {k + 1} of {len(names)}"
    done = sum(shares[each] for each in names[1:k] if each in seconds)
    taken = sum(seconds[each] for each in names[1:k] if each in seconds)
    if not done or taken < 1:
        return words
    left = taken / done * sum(shares[each] for each in names[k:]) / 60
    if left < 1:
        return f"{words}, less than a minute left"
    return f"{words}, about {left:.0f} min left" if left < 90 else f"{words}, about {left / 60:.0f} h left"
