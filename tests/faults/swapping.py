"""Faults in a folder of models that changes under load."""

import json
import shutil
import signal
import threading
import time

import httpx
import numpy as np

from tests.faults.catalogue import FaultTarget
from tests.service.bundles import SCALE, rescale, write_bundle
from tests.service.watching import eventually

CODE = {"latents": [[0.1, 0.7, 0.4]]}


def swap(target: FaultTarget, rng: np.random.Generator) -> str:
    """Change a bundle twelve times under load from four clients; each answer must be of one version."""
    folder = target.folder / "models"
    small = write_bundle(folder, "small")
    aside = target.folder / "aside"
    server = target.start(folder, workers=2, watch=0.1)
    answers: dict[str, set[str]] = {}
    statuses: dict[int, int] = {}
    stop = threading.Event()

    def ask() -> None:
        with httpx.Client(base_url=server.url, timeout=60) as client:
            while not stop.is_set():
                answer = client.post("/v1/models/small/vertices", json=CODE)
                statuses[answer.status_code] = statuses.get(answer.status_code, 0) + 1
                if answer.status_code == 200:
                    body = answer.json()
                    answers.setdefault(body["diagnostics"][0]["model"], set()).add(json.dumps(body["vertices"]))

    def break_it() -> None:
        path = small / "factor-0.onnx"
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)

    def mend() -> None:
        shutil.rmtree(folder / "small", ignore_errors=True)
        write_bundle(folder, "small")

    def take_away() -> None:
        shutil.rmtree(aside, ignore_errors=True)
        (folder / "small").replace(aside)

    def half() -> None:
        (small / "geometry.npz").unlink()

    changes = {
        "broken": break_it, "gone": take_away, "half there": half,
        "in other units": lambda: rescale(small, SCALE * rng.uniform(0.5, 2)),
    }  # fmt: skip
    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    try:
        for name in rng.permutation(sorted(changes) * 3):
            changes[str(name)]()
            if rng.random() < 0.3:
                server.process.send_signal(signal.SIGHUP)
            time.sleep(rng.uniform(0, 0.4))
            mend()
            time.sleep(rng.uniform(0, 0.4))
    finally:
        stop.set()
        for thread in threads:
            thread.join(60)
    with httpx.Client(base_url=server.url, timeout=60) as client:
        eventually(lambda: client.post("/v1/models/small/vertices", json=CODE).status_code == 200)
    # 404 is right while the bundle was gone; no other failure is allowed.
    assert statuses.keys() <= {200, 404}, statuses
    assert all(len(found) == 1 for found in answers.values()), "one version, one answer"
    assert server.process.poll() is None
    assert "Traceback" not in server.log, server.log
    return "12 changes under load: every answer whole and of one version, or 404 while there was none"
