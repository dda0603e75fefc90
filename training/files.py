"""Files that a killed run, or a power cut, leaves whole."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import IO, Any

import numpy as np


def write_npz(path: Path, **arrays: Any) -> None:
    """Write an NPZ file whole or not at all."""
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(file, **arrays)
        _settle(file)
    os.replace(part, path)


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole or not at all."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8 whole or not at all."""
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        file.write(text.encode())
        _settle(file)
    os.replace(part, path)


def _settle(file: IO[bytes]) -> None:
    """Bring a file to the disk: renamed before that, it could be empty after a power cut."""
    file.flush()
    os.fsync(file.fileno())
