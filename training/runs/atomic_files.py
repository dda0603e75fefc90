"""Files of a run that are replaced as a whole, so that a killed run or a power cut leaves no half-written file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.files.atomic import replaced_file
from shapespace.files.npz import read_npz


@dataclass(frozen=True)
class _AtomicFile:
    path: Path

    def exists(self) -> bool:
        """Return whether the file has been written."""
        return self.path.exists()


class TextFile(_AtomicFile):
    """A text file in UTF-8."""

    def read(self) -> str:
        """Return the text; raises OSError or UnicodeDecodeError."""
        return self.path.read_text(encoding="utf-8")

    def write(self, text: str) -> None:
        """Replace the file."""
        with replaced_file(self.path) as file:
            file.write(text.encode())


class JsonFile(_AtomicFile):
    """A file with a JSON object."""

    def read(self) -> dict[str, Any]:
        """Return the object; raises OSError or ValueError."""
        return dict(json.loads(self.path.read_text(encoding="utf-8")))

    def read_if_written(self) -> dict[str, Any]:
        """Return the object, or an empty object if the file has not been written."""
        return self.read() if self.exists() else {}

    def write(self, value: dict[str, Any]) -> None:
        """Replace the file."""
        TextFile(self.path).write(json.dumps(value, indent=2) + "\n")


class NpzFile(_AtomicFile):
    """An NPZ file."""

    def read(self) -> dict[str, NDArray]:
        """Return all arrays by name; raises OSError, ValueError, EOFError or zipfile.BadZipFile."""
        return read_npz(self.path)

    def read_if_written(self) -> dict[str, NDArray]:
        """Return all arrays by name, or none if the file has not been written."""
        return self.read() if self.exists() else {}

    def write(self, **arrays: Any) -> None:
        """Replace the file."""
        with replaced_file(self.path) as file:
            np.savez(file, **arrays)
