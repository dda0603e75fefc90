"""A mixed load for some minutes: ``python -m tests.soak [MINUTES] [--bad SHARE] [--clients N]``.

Calls of every kind about every bundled model, a share of them bad, in random order from several clients. Each answer
is held against that of another server, asked alone beforehand, byte for byte. Ends by itself, with status 1 where an
answer was wrong or memory, threads or file handles grew.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import httpx
import numpy as np

from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, starting
from tests.service.truth import Truth, bad_calls, fingerprint, good_calls

#: What may come on top between the second quarter of the time and the last.
GROWTH = {"MiB": 16.0, "threads": 0.0, "handles": 4.0}
#: Answers that say nothing about the call.
BUSY = 503


def measure(server: Server) -> dict[str, float]:
    """Memory, threads and file handles of a server."""
    place = Path(f"/proc/{server.process.pid}")
    resident = re.search(r"VmRSS:\s+(\d+)", (place / "status").read_text())
    assert resident
    return {
        "MiB": int(resident[1]) / 1024,
        "threads": len(list((place / "task").iterdir())),
        "handles": len(list((place / "fd").iterdir())),
    }


def truth_of(url: str) -> tuple[Truth, int]:
    """What a server answers while nobody else asks, good calls first, and how many those are."""
    rng = np.random.default_rng(0)
    with httpx.Client(base_url=url, timeout=300) as client:
        names = [model["name"] for model in client.get("/v1/models").json()["models"]]
        good = [call for name in names for call in good_calls(client, name, rng, 7 if name == "small" else 2)]
        truth = Truth(client, good + bad_calls("small"))
    assert all(status < 500 for status, *_ in truth.answers.values())
    return truth, len(dict.fromkeys(good))


def load(url: str, truth: Truth, good: int, share: float, end: float, seed: int, outcomes: Counter[str]) -> None:
    """One client, until its time is over."""
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("minutes", type=float, nargs="?", default=30)
    parser.add_argument("--bad", type=float, default=0.2, help="share of bad requests")
    parser.add_argument("--clients", type=int, default=6)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, starting() as start:
        models = Path(folder, "models")
        shutil.copytree(ROOT / "models", models)
        write_bundle(models, "small")
        other = start(models, workers=1, cache=0, deadline=300)
        truth, good = truth_of(other.url)
        other.stop()
        server = start(models, workers=2, deadline=300, watch=1)
        end, outcomes = time.monotonic() + 60 * given.minutes, Counter[str]()
        clients = [
            threading.Thread(target=load, args=(server.url, truth, good, given.bad, end, k, outcomes))
            for k in range(given.clients)
        ]
        for client in clients:
            client.start()
        readings = []
        while time.monotonic() < end:
            time.sleep(1)
            readings.append(measure(server))
        for client in clients:
            client.join()
        log = server.log
    quarter = len(readings) // 4
    pace = outcomes.total() / given.minutes / 60
    print(f"{given.minutes:g} minutes, {given.clients} clients, {pace:.1f} requests a second")
    for says, count in outcomes.most_common():
        print(f"  {says}: {count}")
    ok = not any(says.startswith("wrong") for says in outcomes) and "Traceback" not in log
    for name, most in GROWTH.items():
        parts = readings[quarter : 2 * quarter], readings[-quarter:]
        second, last = (float(np.median([reading[name] for reading in part])) for part in parts)
        peak = max(r[name] for r in readings)
        print(f"  {name}: {second:.0f} in the second quarter, {last:.0f} in the last, {peak:.0f} at most")
        ok = ok and last <= second + most
    print("flat, and every answer right" if ok else "NOT as it should be")
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
