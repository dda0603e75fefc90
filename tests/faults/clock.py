"""A system clock that jumps for one process and its children only."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

YEAR = 365.25 * 86400
#: Run by Python at its start. Monotonic clocks are not changed, as when a system's clock is set.
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
class JumpingClock:
    """A clock's offset, in a file."""

    file: Path

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables with which a process uses this clock."""
        paths = [str(self.file.parent), os.environ.get("PYTHONPATH", ""), str(Path(__file__).parents[2])]
        return os.environ | {"CLOCK_OFFSET": str(self.file), "PYTHONPATH": os.pathsep.join(filter(None, paths))}

    def jump(self, years: float) -> None:
        """Set its offset from the real clock."""
        part = self.file.with_suffix(".part")
        part.write_text(str(years * YEAR))
        part.replace(self.file)


@contextmanager
def jumping_clock(folder: Path) -> Iterator[JumpingClock]:
    """A clock without an offset yet."""
    (folder / "clock").mkdir()
    (folder / "clock" / "sitecustomize.py").write_text(_SHIM)
    clock = JumpingClock(folder / "clock" / "offset")
    clock.jump(0)
    yield clock
