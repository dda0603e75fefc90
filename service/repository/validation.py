"""The bundles of a folder, and their validation in a separate process before the server reads them."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from pathlib import Path

from shapespace.service.limits.sandbox import VALIDATE, Sandbox
from shapespace.service.limits.sandbox_messages import ClosedError
from shapespace.solve.deadline import Deadline

# Limits on the validation of one bundle. Memory for the solver is added once the size of the mesh is known.

SECONDS = 60.0
#: Bytes in addition to those for the files, of which a bundle may have at most MOST_FILE_BYTES.
MEMORY, MOST_FILE_BYTES = 512 * 2**20, 2**30
#: Factor of the size of the files. While ONNX Runtime loads a network, memory holds it as read, as parsed, as checked,
#: and three times in ONNX Runtime.
COPIES = 6


def bundle_folders(folder: Path) -> tuple[list[Path], dict[Path, OSError]]:
    """Return folders NAME/VERSION, and folders NAME that cannot be read, but no hidden entries; raises OSError."""
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
    """Validates bundles one after the other in the background."""

    def __init__(self) -> None:
        self._sandbox = Sandbox(1, VALIDATE)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="validation")
        self._digests: dict[Path, Future[str]] = {}
        self._lock, self._closed = threading.Lock(), False

    def prepare(self) -> None:
        """Start a process that imports the modules of validation; does not wait for it."""
        self._sandbox.prepare()

    def begin(self, folders: Iterable[Path]) -> None:
        """Start to validate bundles that are not validated yet, in this order; does not wait for them."""
        for folder in folders:
            with self._lock:
                if folder not in self._digests and not self._closed:
                    self._digests[folder] = self._thread.submit(self._validate, folder)

    def digest(self, folder: Path) -> str:
        """Return the digest of a bundle once it is validated; raises SandboxError, ClosedError if it never will be."""
        self.begin([folder])
        try:
            return self._digests[folder].result()
        except (KeyError, CancelledError):
            raise ClosedError("nothing is validated any more") from None

    def close(self) -> None:
        """End running validations."""
        with self._lock:
            self._closed = True
        self._sandbox.close()
        self._thread.shutdown(cancel_futures=True)

    def _validate(self, folder: Path) -> str:
        memory = MEMORY + COPIES * min(_bytes(folder), MOST_FILE_BYTES)
        facts, _ = self._sandbox.call({"folder": str(folder)}, deadline=Deadline(SECONDS), memory=memory)
        return str(facts["digest"])


def _bytes(folder: Path) -> int:
    try:
        with os.scandir(folder) as entries:
            return sum(entry.stat(follow_symlinks=False).st_size for entry in entries)
    except OSError:
        return 0  # validation reports the reason
