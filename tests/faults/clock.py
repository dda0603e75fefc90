"""A clock that jumps for one process and its children, and not for the whole machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

YEAR = 365.25 * 86400
#: Python runs it before anything else. Monotonic clocks stay as they are, as they do when a clock is set.
_SHIM = """
import os, time
def offset():
    try:
        with open(os.environ["CLOCK_OFFSET"]) as file:
            return float(file.read() or 0)
    except OSError:
        return 0.0
real, real_ns = time.time, time.time_ns
time.time = lambda: real() + offset()
time.time_ns = lambda: real_ns() + int(offset() * 1e9)
"""


@dataclass(frozen=True)
class Clock:
    """A clock's offset, in a file."""

    file: Path

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs to follow it."""
        paths = [str(self.file.parent), os.environ.get("PYTHONPATH", ""), str(Path(__file__).parents[2])]
        return os.environ | {"CLOCK_OFFSET": str(self.file), "PYTHONPATH": os.pathsep.join(filter(None, paths))}

    def jump(self, years: float) -> None:
        """Set it so far from the real one, all at once."""
        part = self.file.with_suffix(".part")
        part.write_text(str(years * YEAR))
        part.replace(self.file)


@contextmanager
def jumping_clock(folder: Path) -> Iterator[Clock]:
    """A clock at the right time, ready to jump."""
    (folder / "clock").mkdir()
    (folder / "clock" / "sitecustomize.py").write_text(_SHIM)
    clock = Clock(folder / "clock" / "offset")
    clock.jump(0)
    yield clock
