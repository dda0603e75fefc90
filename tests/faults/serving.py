"""A server into which faults are injected, and which must be in its former state afterwards."""

import re
from pathlib import Path

import httpx
import numpy as np

from tests.service.bundles import write_bundle
from tests.service.conftest import Server, Start
from tests.service.truth import Truth, bad_calls, good_calls
from tests.service.watching import admitted, eventually


def peak_memory(server: Server) -> int:
    """Peak resident memory of the process so far, in bytes."""
    status = Path(f"/proc/{server.process.pid}/status").read_text()
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    assert found
    return int(found[1]) * 1024


class Steady:
    """A server whose answers were recorded before any fault."""

    def __init__(self, folder: Path, start: Start, **settings: object) -> None:
        self.models = folder / "models"
        write_bundle(self.models, "small")
        write_bundle(self.models, "with-fine", fine=True)
        self.server = start(self.models, workers=2, **settings)
        self.url = self.server.url
        self.place = httpx.URL(self.url)
        self.client = httpx.Client(base_url=self.url, timeout=120)
        rng = np.random.default_rng(0)
        calls = good_calls(self.client, "small", rng, 2) + good_calls(self.client, "with-fine", rng, 1)
        self.truth = Truth(self.client, calls + bad_calls("small"))
        statuses = {call: answer[0] for call, answer in self.truth.answers.items()}
        assert all(status < 500 for status in statuses.values()), statuses
        self._handles, self._threads, self._read = self.handles, self.threads, 0

    @property
    def handles(self) -> int:
        """Number of files and sockets that the process has open."""
        return len(list(Path(f"/proc/{self.server.process.pid}/fd").iterdir()))

    @property
    def threads(self) -> int:
        return len(list(Path(f"/proc/{self.server.process.pid}/task").iterdir()))

    def close(self) -> None:
        self.client.close()

    def check(self) -> None:
        """Assert that it is idle, answers as before, has no more handles or threads, and logged no error."""
        assert self.server.process.poll() is None, self.server.log
        assert self.truth.differing() == []
        eventually(lambda: admitted(self.client) == 0)
        eventually(lambda: self.handles <= self._handles + 2)
        # Threads of workers and for reading bodies are started when they are first needed.
        assert self.threads <= self._threads + 4
        # An error is reported for the fault that caused it, not for later ones.
        log, self._read = self.server.log[self._read :], len(self.server.log)
        assert "Traceback" not in log, log
