"""Shapes of one client while another one runs fits: ``python -m benchmarks.beside_fits`` prints a table of ratios.

Both parts run against one server process, one right after the other, so that the ratio depends little on the machine.
"""

from __future__ import annotations

import argparse
import threading
import time
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np

from benchmarks.pages import table
from benchmarks.processes import server


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder with the figure and the torus")
    parser.add_argument("--workers", type=int, default=2, help="workers of the server")
    parser.add_argument("--fits", type=int, default=26, help="fits at one time, all of one address")
    parser.add_argument("--seconds", type=float, default=30, help="time of each part")
    given = parser.parse_args()
    with server(given.models, workers=given.workers) as (client, _, _):
        code = ",".join(["0.3"] * 20)
        scan = client.get("/v1/models/figure/mesh", params={"latent": code, "format": "obj"}).content
        shapes(client, 2)
        alone = shapes(client, given.seconds)
        over = threading.Event()

        def fit(seed: int) -> None:
            with httpx.Client(base_url=client.base_url, timeout=300) as own, suppress(httpx.HTTPError):
                while not over.is_set():
                    own.post("/v1/models/figure/fit", params={"format": "obj", "seed": seed}, content=scan)

        threads = [threading.Thread(target=fit, args=(seed,), daemon=True) for seed in range(given.fits)]
        for thread in threads:
            thread.start()
        time.sleep(1)
        beside = shapes(client, given.seconds)
        over.set()
        quantiles = 0.5, 0.99
        rows = [
            [name, str(len(times)), *(f"{1e3 * np.quantile(times, q):.0f}" for q in quantiles)]
            for name, times in (("alone", alone), (f"beside {given.fits} fits", beside))
        ]
        ratios = (f"{np.quantile(beside, q) / np.quantile(alone, q):.2f}" for q in quantiles)
        print(table(("torus, ms", "requests", "p50", "p99"), [*rows, ["ratio", "", *ratios]]))


def shapes(client: httpx.Client, seconds: float) -> list[float]:
    """Ask for new shapes of the torus from another address, one after the other; return their times."""
    times: list[float] = []
    transport = httpx.HTTPTransport(local_address="127.0.0.2")
    with httpx.Client(base_url=client.base_url, timeout=60, transport=transport) as other:
        end = time.perf_counter() + seconds
        while (began := time.perf_counter()) < end:
            latent = f"{began % 6:.6f},1,2,3"
            other.get("/v1/models/freaky-torus/mesh", params={"latent": latent}).raise_for_status()
            times.append(time.perf_counter() - began)
    return times


if __name__ == "__main__":
    main()
