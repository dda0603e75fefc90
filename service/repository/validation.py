"""Bundles of a folder, and their validation in a process of its own before the server reads them itself."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from pathlib import Path

from shapespace.service.limits.sandbox import Sandbox
from shapespace.service.limits.sandbox_errors import ClosedError
from shapespace.solve.deadline import Deadline

#: Limits of validating one bundle: seconds, and memory in bytes, to which this many times the size of its files is
#: added: a network is in memory as read, as parsed, as checked, and three times in ONNX Runtime while that loads it.
#: The memory of the solver is added once the size of the mesh is known.
SECONDS, MEMORY, MEMORY_PER_BYTE = 60.0, 512 * 2**20, 6
#: Largest size of the files that counts towards that, which is also the largest that a bundle may have.
_MOST = 2**30


def bundle_folders(folder: Path) -> tuple[list[Path], dict[Path, OSError]]:
    """Folders NAME/VERSION, and those of names that can't be read; hidden entries and plain files are passed over.

    Raises:
        OSError: the folder itself can't be read.
    """
    found: list[Path] = []
    unreadable = {}
    for name in sorted(folder.iterdir()):
        try:
            if not name.name.startswith(".") and name.is_dir():
                found += sorted(path for path in name.iterdir() if not path.name.startswith(".") and path.is_dir())
        except OSError as error:
            unreadable[name] = error
    return found, unreadable


class BundleValidator:
    """Validates bundles one after the other, ahead of whoever asks for the outcome."""

    def __init__(self) -> None:
        self._sandbox = Sandbox(1)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="validation")
        self._digests: dict[Path, Future[str]] = {}
        self._lock, self._closed = threading.Lock(), False

    def prepare(self) -> None:
        """Have a process import what validation needs; doesn't wait for it."""
        self._sandbox.prepare("validate")

    def begin(self, folders: Iterable[Path]) -> None:
        """Validate bundles that haven't been, in this order; doesn't wait for them."""
        for folder in folders:
            with self._lock:
                if folder not in self._digests and not self._closed:
                    self._digests[folder] = self._thread.submit(self._validate, folder)

    def digest(self, folder: Path) -> str:
        """The digest of a bundle that has passed.

        Raises:
            SandboxError: what is wrong with it.
            ClosedError: it has not been validated.
        """
        self.begin([folder])
        try:
            return self._digests[folder].result()
        except (KeyError, CancelledError):
            raise ClosedError("nothing is validated any more") from None

    def close(self) -> None:
        """End what still runs."""
        with self._lock:
            self._closed = True
        self._sandbox.close()
        self._thread.shutdown(cancel_futures=True)

    def _validate(self, folder: Path) -> str:
        memory = MEMORY + MEMORY_PER_BYTE * min(_bytes(folder), _MOST)
        facts, _ = self._sandbox.call("validate", {"folder": str(folder)}, deadline=Deadline(SECONDS), memory=memory)
        return str(facts["digest"])


def _bytes(folder: Path) -> int:
    try:
        with os.scandir(folder) as entries:
            return sum(entry.stat(follow_symlinks=False).st_size for entry in entries)
    except OSError:
        return 0  # validation will say
