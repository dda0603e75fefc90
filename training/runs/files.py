"""Files that a killed run, or a power cut, leaves whole."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np


@contextmanager
def whole(path: Path) -> Iterator[IO[bytes]]:
    """A file to write to that takes the path's place at the end, whole, or not at all."""
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        yield file
        # Renamed before it is on the disk, it could be empty after a power cut.
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def write_npz(path: Path, **arrays: Any) -> None:
    """Write an NPZ file whole or not at all."""
    with whole(path) as file:
        np.savez(file, **arrays)


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole or not at all."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8 whole or not at all."""
    with whole(path) as file:
        file.write(text.encode())
