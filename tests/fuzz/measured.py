"""The server with a meter of its event loop: ``python -m tests.fuzz.measured SOCKET``.

It answers as ``python -m shapespace.service`` does. Over a unix socket it takes two words, each on its own
connection: ``reset`` collects garbage, returns free memory to the system and resets the meter; ``read``
answers its values as JSON.
"""

import ctypes
import gc
import json
import os
import socket
import sys
import threading
import time
from asyncio import AbstractEventLoop, events
from pathlib import Path

#: Seconds between two beats of the loop while something is measured.
BEAT = 0.01


class Meter:
    """What the event loop of this process has done since the last reset.

    ``loop`` is the longest single callback in seconds of CPU time of the loop's own thread, so that neither
    other processes nor other threads count. ``wall`` is the longest in wall-clock time. ``stall`` is the
    longest time for which the loop could not run, because of a callback or of a thread that held the
    interpreter lock. It is the delay of a beat, less the time for which the loop's thread was ready but had
    no processor, and at most the CPU time that all threads of this process took meanwhile.
    """

    def __init__(self) -> None:
        self.watching = False
        self._resets = 0
        self._loop: AbstractEventLoop | None = None
        self._times: dict[str, float] = {}
        self._name = ""
        self._clock = time.pthread_getcpuclockid(threading.main_thread().ident or 0)
        self._running: tuple[object, float, float] | None = None
        self._run = events.Handle._run

    def install(self) -> None:
        """Time every callback of every event loop; to be called before a loop is created."""
        run, meter = self._run, self

        def timed(handle: events.Handle) -> None:
            if not meter.watching:
                if meter._loop is None:
                    meter._loop = handle._loop  # type: ignore[attr-defined]
                run(handle)
                return
            # Keep the callback: a handle that is cancelled meanwhile loses it.
            meter._running = handle._callback, time.perf_counter(), time.thread_time()
            run(handle)
            meter._took(*meter._running)
            meter._running = None

        events.Handle._run = timed  # type: ignore[method-assign]
        gc.callbacks.append(self._collected)

    def reset(self) -> None:
        gc.collect()
        if sys.platform == "linux":
            ctypes.CDLL(None).malloc_trim(0)
        self._times, self._name = {"loop": 0.0, "wall": 0.0, "stall": 0.0, "collecting": 0.0}, ""
        self.watching = True
        self._resets += 1
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._beat, self._resets, None)

    def read(self) -> dict[str, float | str]:
        self.watching = False
        if running := self._running:  # a callback that has not ended yet counts too
            self._took(*running)
        return {**self._times, "where": self._name}

    def _took(self, callback: object, wall: float, cpu: float) -> None:
        self._note("wall", time.perf_counter() - wall)
        if self._note("loop", time.clock_gettime(self._clock) - cpu):
            self._name = _name(callback)

    def _note(self, name: str, seconds: float) -> bool:
        largest = seconds > self._times[name]
        if largest:
            self._times[name] = seconds
        return largest

    def _beat(self, resets: int, before: tuple[float, float, float] | None) -> None:
        if not self.watching or resets != self._resets:
            return
        now = time.perf_counter(), time.process_time(), _kept_waiting()
        if before:
            late, busy, waited = (b - a for a, b in zip(before, now, strict=True))
            self._note("stall", min(late - BEAT - waited, busy))
        if self._loop is not None:
            self._loop.call_later(BEAT, self._beat, resets, now)

    def _collected(self, phase: str, _: dict[str, int]) -> None:
        if phase == "start":
            self._began = time.thread_time()
        elif self.watching and threading.current_thread() is threading.main_thread():
            self._note("collecting", time.thread_time() - self._began)


def _kept_waiting() -> float:
    """Seconds for which the main thread was ready but had no processor."""
    return int(Path("/proc/self/schedstat").read_text().split()[1]) / 1e9


def _name(callback: object) -> str:
    """The name of a callback: that of a task's coroutine, or of the function."""
    task = getattr(callback, "__self__", None)
    if hasattr(task, "get_coro"):
        return str(getattr(task.get_coro(), "__qualname__", task))
    return str(getattr(callback, "__qualname__", callback))


def attend(meter: Meter, place: str) -> None:
    """Answer words on the socket, forever."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(place)
        listener.listen()
        while True:
            connection, _ = listener.accept()
            with connection:
                if connection.recv(16) == b"read":
                    connection.sendall(json.dumps(meter.read()).encode())
                else:
                    meter.reset()
                    connection.sendall(b"{}")


def main() -> None:
    place = sys.argv[1]
    meter = Meter()
    meter.install()
    threading.Thread(target=attend, args=(meter, place), daemon=True).start()
    # Imported after the meter is installed, so that all of it is measured.
    from shapespace.service.__main__ import main as serve

    serve([])


if __name__ == "__main__":
    os.umask(0o077)
    main()
