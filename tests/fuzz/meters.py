"""What processes take, seen from outside: time without waits for a processor, and peaks of memory."""

import contextlib
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from tests.service.watching import processes


class ProcessorClock:
    """Seconds since its creation, less those in which this thread or a server's waited for a processor."""

    def __init__(self, pid: int) -> None:
        self._places = ("/proc/thread-self/schedstat", f"/proc/{pid}/schedstat")
        self._began, self._waited = time.monotonic(), [0.0, 0.0]
        self._waited = self._waiting()

    def _waiting(self) -> list[float]:
        waited = []
        for place, before in zip(self._places, self._waited, strict=True):
            try:
                waited.append(int(Path(place).read_text().split()[1]) / 1e9)
            except OSError:  # it has ended
                waited.append(before)
        return waited

    @property
    def seconds(self) -> float:
        """Only the longer of both waits is subtracted: usually one thread waits while the other runs."""
        waited = max(now - before for now, before in zip(self._waiting(), self._waited, strict=True))
        return time.monotonic() - self._began - waited


class Peaks:
    """The growth of the memory of a process and its children, together, from its creation to the peak.

    The kernel keeps the peak of each process (VmHWM), which is reset at every reading: the sum of the peaks
    between two readings is never less than the true common peak, and hardly more. For a process that starts
    later, growth is counted from the smallest size of other children before a request, or without these
    from its first reading.
    """

    #: Bytes of the smallest child process ever seen before a request.
    smallest = 0

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._before: dict[int, int] = {}
        #: Bytes, of all processes together.
        self.growth = 0
        for each in processes(pid):
            with contextlib.suppress(OSError):
                self._before[each] = self._read(each)["VmRSS"]
        children = [size for each, size in self._before.items() if each != pid]
        Peaks.smallest = min([*children, Peaks.smallest]) if Peaks.smallest else min(children, default=0)

    @staticmethod
    def _read(pid: int) -> dict[str, int]:
        status = Path(f"/proc/{pid}/status").read_text()
        Path(f"/proc/{pid}/clear_refs").write_text("5")
        found = re.findall(r"(VmHWM|VmRSS):\s+(\d+) kB", status)
        return {name: int(size) * 1024 for name, size in found} or {"VmHWM": 0, "VmRSS": 0}

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Read regularly meanwhile, as a process that ends leaves no reading."""
        done = threading.Event()

        def look() -> None:
            while not done.wait(0.002):
                self._look()

        thread = threading.Thread(target=look)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
            self._look()

    def _look(self) -> None:
        total = 0
        for pid in processes(self._pid):
            with contextlib.suppress(OSError):
                now = self._read(pid)
                before = self._before.setdefault(pid, max(now["VmRSS"], Peaks.smallest))
                total += max(0, now["VmHWM"] - before)
        self.growth = max(self.growth, total)
