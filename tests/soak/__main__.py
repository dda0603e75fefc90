"""A mixed load: ``python -m tests.soak [MINUTES] [--bad SHARE] [--clients N] [--attacks NAME …]``.

Several clients send calls of every kind for every bundled model in random order, a share of them invalid,
while the server is attacked from another address in every other minute. Each answer is compared byte for
byte with that of another server, which was asked beforehand without load. The exit status is 1 if an answer
was wrong, an attack affected other clients, health took longer than a second, or memory, threads or file
handles grew.
"""

import argparse
import contextlib
import itertools
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np

from tests.attacks import ATTACKS, PROMPT
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, starting
from tests.service.truth import Truth, bad_calls, fingerprint, good_calls
from tests.service.watching import processes

#: Largest growth between the second quarter of the time and the last, measured between attacks.
GROWTH = {"MiB": 16.0, "threads": 0.0, "handles": 4.0}
#: Status of answers that are not compared: the server was busy.
BUSY = 503
#: Seconds within which SIGTERM ends a server that doesn't drain.
ENDING = 3.0
#: Longest attack in seconds, and its address, other than the clients', as limits are for each address.
ATTACK, STRANGER = 60.0, "127.0.0.2"


def measure(server: Server) -> dict[str, float]:
    """Memory, threads and file handles of a server and its child processes; pages that they share count once."""
    total = dict.fromkeys(GROWTH, 0.0)
    for pid in processes(server.process.pid):
        place = Path(f"/proc/{pid}")
        with contextlib.suppress(OSError):  # a child may just have ended
            proportional = re.search(r"Pss:\s+(\d+)", (place / "smaps_rollup").read_text())
            total["MiB"] += int(proportional[1]) / 1024 if proportional else 0
            total["threads"] += len(list((place / "task").iterdir()))
            total["handles"] += len(list((place / "fd").iterdir()))
    return total


def truth_of(url: str) -> tuple[Truth, int]:
    """The answers of a server without load, those of valid calls first, and the number of valid calls."""
    rng = np.random.default_rng(0)
    with httpx.Client(base_url=url, timeout=300) as client:
        names = [model["name"] for model in client.get("/v1/models").json()["models"]]
        good = [call for name in names for call in good_calls(client, name, rng, 7 if name == "small" else 2)]
        truth = Truth(client, good + bad_calls("small"))
    assert all(status < 500 for status, *_ in truth.answers.values())
    return truth, len(dict.fromkeys(good))


def load(url: str, truth: Truth, good: int, share: float, end: float, seed: int, outcomes: Counter[str]) -> None:
    """One client, which sends calls until the time is over."""
    rng, calls = np.random.default_rng(seed), list(truth.answers.items())
    with httpx.Client(base_url=url, timeout=300) as client:
        while time.monotonic() < end:
            bad = rng.random() < share
            call, then = calls[rng.integers(good, len(calls)) if bad else rng.integers(good)]
            try:
                now = fingerprint(call.send(client))
            except httpx.HTTPError as error:
                outcomes[f"wrong: {call.method} {call.path[:100]} {error!r}"] += 1
                continue
            if now[0] == BUSY:
                outcomes["busy"] += 1
                time.sleep(0.2)
            elif now == then:
                outcomes["refused as expected" if bad else "right"] += 1
            else:
                outcomes[f"wrong: {call.method} {call.path[:100]} {now[0]}"] += 1


def ask_health(url: str, end: float, outcomes: Counter[str]) -> None:
    """Ask for health twice a second, each time on a new connection."""
    while time.monotonic() < end:
        try:
            slow = (
                httpx.get(f"{url}/v2/health/live", timeout=PROMPT).raise_for_status().elapsed.total_seconds() > PROMPT
            )
        except httpx.HTTPError:
            slow = True
        outcomes["wrong: health not within a second" if slow else "healthy"] += 1
        time.sleep(0.5)


class Strangers:
    """Attacks, one after the other, each after a pause of the same length.

    Attributes:
        at_work: whether an attack is running.
    """

    def __init__(self, url: str, names: list[str], end: float, outcomes: Counter[str]) -> None:
        self._url, self._names, self._end, self._outcomes = url, names, end, outcomes
        self.at_work = False

    def run(self) -> None:
        """Attack until the time is over, so that each attack runs at least twice."""
        seconds = min(ATTACK, (self._end - time.monotonic()) / (4 * len(self._names) + 1))
        for name in itertools.cycle(self._names):
            time.sleep(seconds)
            if time.monotonic() + seconds > self._end:
                break
            with self._attacking():
                try:
                    outcome = ATTACKS[name](self._url, seconds, source=STRANGER)
                except httpx.HTTPError as error:
                    self._outcomes[f"wrong: no {name} any more: {error!r}"] += 1
                    continue
            print(f"  {name} for {seconds:.0f} s: {'held' if outcome.held else 'FELL'}: {outcome}", flush=True)
            self._outcomes[f"attack held: {name}" if outcome.held else f"wrong: {name} was felt by others"] += 1

    @contextlib.contextmanager
    def _attacking(self) -> Iterator[None]:
        self.at_work = True
        yield
        self.at_work = False


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("minutes", type=float, nargs="?", default=30)
    parser.add_argument("--bad", type=float, default=0.2, help="share of bad requests")
    parser.add_argument("--clients", type=int, default=6)
    parser.add_argument("--attacks", nargs="+", choices=[*ATTACKS, "none"], default=[*ATTACKS], metavar="NAME")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, starting() as start:
        models = Path(folder, "models")
        shutil.copytree(ROOT / "models", models)
        write_bundle(models, "small")
        other = start(models, workers=1, cache=0, deadline=300)
        truth, good = truth_of(other.url)
        other.stop()
        # The cache is small, so that it is full before memory is compared.
        server = start(models, workers=2, deadline=300, watch=1, cache=2**22)
        end, outcomes = time.monotonic() + 60 * given.minutes, Counter[str]()
        strangers = Strangers(server.url, [name for name in given.attacks if name != "none"], end, outcomes)
        clients = [
            threading.Thread(target=load, args=(server.url, truth, good, given.bad, end, k, outcomes))
            for k in range(given.clients)
        ]
        clients.append(threading.Thread(target=ask_health, args=(server.url, end, outcomes)))
        clients.append(threading.Thread(target=strangers.run))
        for client in clients:
            client.start()
        readings, peaks = [], Counter[str]()
        while time.monotonic() < end:
            time.sleep(1)
            reading = measure(server)
            peaks |= Counter(reading)
            if not strangers.at_work:
                readings.append(reading)
        for client in clients:
            client.join()
        began = time.monotonic()
        try:
            log = server.stop()
        except subprocess.TimeoutExpired:
            server.process.kill()
            log = server.log
        outcomes[
            "ended when asked to" if time.monotonic() - began < ENDING else "wrong: it doesn't end when asked to"
        ] += 1
    quarter = len(readings) // 4
    pace = outcomes.total() / given.minutes / 60
    print(f"{given.minutes:g} minutes, {given.clients} clients, {pace:.1f} requests a second")
    for says, count in outcomes.most_common():
        print(f"  {says}: {count}")
    ok = not any(says.startswith("wrong") for says in outcomes) and "Traceback" not in log
    for name, most in GROWTH.items():
        parts = readings[quarter : 2 * quarter], readings[-quarter:]
        second, last = (float(np.median([reading[name] for reading in part])) for part in parts)
        print(f"  {name}: {second:.0f} in the second quarter, {last:.0f} in the last, {peaks[name]:.0f} at most")
        ok = ok and last <= second + most
    print("flat, and every answer right" if ok else "NOT as it should be")
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
