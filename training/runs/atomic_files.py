"""Files of a run that are replaced as a whole, so that a killed run or a power cut leaves no half-written file.

A file can be damaged all the same, by a disk or a copy. Whoever reads it learns which one: DamagedFileError.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.files.atomic import replaced_file
from shapespace.files.npz import read_npz


class DamagedFileError(ValueError):
    """A file of a run that can't be understood, with its path."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} is damaged; give the command run for this run again, which computes it again")
        self.path = path


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn errors of a damaged file into DamagedFileError; OSError passes."""
    try:
        yield
    except (OSError, MemoryError, DamagedFileError):
        raise
    except Exception as error:  # `zipfile`, `zlib`, `json` and NumPy raise exceptions of many classes
        raise DamagedFileError(path) from error


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
        """Return the object; raises OSError or DamagedFileError."""
        with reading(self.path):
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
        """Return all arrays by name; raises OSError or DamagedFileError."""
        with reading(self.path):
            return read_npz(self.path)

    def read_if_written(self) -> dict[str, NDArray]:
        """Return all arrays by name, or none if the file has not been written."""
        return self.read() if self.exists() else {}

    def write(self, **arrays: Any) -> None:
        """Replace the file."""
        with replaced_file(self.path) as file:
            np.savez(file, **arrays)
