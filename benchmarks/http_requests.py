"""Requests over HTTP to a server process, measured by the clock: part of ``python -m benchmarks.serving``."""

import os
import statistics
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import httpx
import numpy as np

from benchmarks.bundles import bundles, draw, normal_matrix, superlu
from benchmarks.pages import table
from benchmarks.processes import processor, resident, server
from shapespace.bundle.reader import read_bundle
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel


def http(models: Path, count: int, duration: float) -> None:
    """Measure a server process with one client and with sixteen."""
    names = {path.parent.name: ShapeModel(read_bundle(path)) for path in bundles(models)}
    with (
        server(models, ("benchmarks.pca_server", str(models))) as (plain, _, _),
        server(models, cache=0) as (client, pid, ready),
    ):
        used, memory = processor(pid), resident(pid)
        rows, rates, late, requests, failed = [], list[str](), list[str](), 0, 0
        for name, model in names.items():
            for clients, limit in ((1, count), (16, 10**9)):
                began = processor(pid)
                times, errors = load(client, name, model, clients, limit, duration if clients > 1 else 1e9)
                spent = (processor(pid) - began) / len(times)
                quantiles = [float(np.quantile(times, q)) for q in (0.5, 0.95, 0.99)]
                requests, failed = requests + len(times), failed + errors
                if clients > 1:
                    rates.append(f"{len(times) / duration:.0f}")
                    late.append(f"{1e3 * quantiles[2]:.0f}")
                rows.append([f"{name}, {clients}", *(f"{1e3 * value:.1f}" for value in (*quantiles, spent))])
        print("\n## Over HTTP\n")
        print(
            f"With sixteen clients the server answers {' and '.join(rates)} shapes per second of the two models.",
            end=" ",
        )
        print(f"The slowest 1 % of the requests then take more than {' and '.join(late)} ms.\n")
        print(table(("model, clients", "p50", "p95", "p99", "CPU time"), rows))
        print("\np50 to p99 are milliseconds by the clock for a GLB of the fine mesh, without a cache, on")
        print(f"{os.cpu_count()} cores with as many workers. There were {requests} requests and {failed} errors.")
        print(f"The server was ready {ready:.1f} s")
        print(f"after its start, or {used:.1f} s of CPU time. It had {memory:.0f} MB of memory then, and")
        print(f"{resident(pid):.0f} MB in the end.\n")
        print("The next table has one client, and the times of one factorisation by SuperLU and of a PCA server.\n")
        beside = [[name, *compared(client, plain, name, model, count)] for name, model in names.items()]
        print(table(("model", "auto", "full", "draft", "SuperLU, PCA server"), beside))
        print(
            "\nTimes are medians in milliseconds by the clock, measured in turn. In brackets are multiples of SuperLU"
        )
        print("and of the PCA server, which adds m fields to a mean and writes the same GLB.\n")
        print("The first frame of an animation arrives sooner than one frame that is requested alone.\n")
        animations = [[name, *interpolation(client, pid, name, model)] for name, model in names.items()]
        print(
            table(
                ("60 frames", "first frame", "one frame alone", "frames per s", "frames per CPU s: lines, GLB"),
                animations,
            )
        )
        print("\nAnimations are streamed as JSON lines, or come whole as one GLB. Times of frames are milliseconds.")


def compared(client: httpx.Client, plain: httpx.Client, name: str, model: ShapeModel, count: int) -> list[str]:
    """Return the times of one client by quality, and of the references, measured in turn."""
    factorise = superlu(normal_matrix(model, model.reference.vertices))
    times: dict[str, list[float]] = {}
    for code in draw(model, count + 3).tolist():
        asked: dict[str, Callable[[], object]] = {
            quality: partial(client.post, f"/v1/models/{name}/mesh", json={"latent": code, "quality": quality})
            for quality in Quality
        }
        asked |= {"PCA": partial(plain.post, f"/v1/models/{name}/mesh", json={"latent": code}), "SuperLU": factorise}
        for key, call in asked.items():
            began = time.perf_counter()
            call()
            times.setdefault(key, []).append(time.perf_counter() - began)
    median = {key: 1e3 * statistics.median(values[3:]) for key, values in times.items()}
    cells = [
        f"{median[quality]:.1f} ({median[quality] / median['SuperLU']:.2f}, {median[quality] / median['PCA']:.1f})"
        for quality in Quality
    ]
    return [*cells, f"{median['SuperLU']:.1f}, {median['PCA']:.1f}"]


def load(
    client: httpx.Client, name: str, model: ShapeModel, clients: int, limit: int, duration: float
) -> tuple[list[float], int]:
    """Send requests for new codes; return their times and the number that failed."""
    codes = iter(draw(model, min(clients * limit, 20_000)).tolist())
    times: list[float] = []
    errors = 0
    lock, end = threading.Lock(), time.perf_counter() + duration

    def work() -> None:
        nonlocal errors
        with httpx.Client(base_url=client.base_url, timeout=120) as own:
            for _ in range(limit):
                with lock:
                    code = next(codes, None)
                if code is None or time.perf_counter() > end:
                    return
                began = time.perf_counter()
                answer = own.post(f"/v1/models/{name}/mesh", json={"latent": code})
                times.append(time.perf_counter() - began)
                errors += answer.status_code != 200

    threads = [threading.Thread(target=work) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return times, errors


def interpolation(client: httpx.Client, pid: int, name: str, model: ShapeModel) -> list[str]:
    """Return the time to the first line, the time of a frame by itself, and rates."""
    path = f"/v1/models/{name}/interpolations"
    keyframes = draw(model, 4).tolist()
    links = client.post(path, json={"keyframes": keyframes, "frames": 60}).raise_for_status().json()["links"]
    alone = []
    for k in range(8):
        began = time.perf_counter()
        client.get(links["frames"].replace("{k}", str(k)), params={"format": "json"}).raise_for_status()
        alone.append(time.perf_counter() - began)
    first = []
    for _ in range(9):
        began = time.perf_counter()
        with client.stream("GET", links["jsonl"]) as answer:
            next(answer.iter_lines())
            first.append(time.perf_counter() - began)
        time.sleep(0.5)  # for the frames that were begun and that nobody waits for any more
    began, spent = time.perf_counter(), processor(pid)
    with client.stream("GET", links["jsonl"]) as answer:
        count = sum(1 for _ in answer.iter_lines())
    rate, per_second = count / (time.perf_counter() - began), count / (processor(pid) - spent)
    spent = processor(pid)
    client.get(links["glb"]).raise_for_status()
    whole = count / (processor(pid) - spent)
    times = (f"{1e3 * statistics.median(each):.1f}" for each in (first, alone))
    return [*times, f"{rate:.0f}", f"{per_second:.0f}, {whole:.0f}"]
