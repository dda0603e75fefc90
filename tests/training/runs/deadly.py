"""A function that kills its process; here alone, so that workers need not import what tests do."""

import signal
from pathlib import Path


def die_once(mark: Path, item: int) -> int:
    if item == 2 and not mark.exists():
        mark.touch()
        signal.raise_signal(signal.SIGKILL)
    return item**2
