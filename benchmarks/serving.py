"""A request's time by stage, for every bundled model: ``python -m benchmarks.serving``.

Prints a Markdown table. In process: networks, Gauss–Newton and encoding, once right after loading and then as medians
over codes drawn from the model's bounds. Beside them, in the same run and on the same thread, one SuperLU factorisation
of the model's own Gauss–Newton matrix, which is the yardstick that travels between machines. Then the same request over
HTTP, from a server process on this machine.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from geometry.formats import MESH_FORMATS
from geometry.mesh import FloatArray
from geometry.nric import NRICJacobian, WeightedNorm
from service.bundle import read_bundle
from service.shape_model import ShapeModel

GLB = MESH_FORMATS["glb"].encode


def seconds(work: Callable[[], object]) -> float:
    """Time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def normal_matrix(model: ShapeModel, vertices: FloatArray) -> sparse.csc_array:
    """``JᵀWJ + εI`` at a normalised shape, as Gauss–Newton factorises it."""
    weights = WeightedNorm.of(model.reference, model.manifest.eta_reconstruction).squared
    jacobian = NRICJacobian(model.reference.connectivity)(vertices)
    matrix = (jacobian.T @ sparse.diags_array(weights) @ jacobian).tocsc()
    return sparse.csc_array(matrix + 1e-9 * matrix.diagonal().mean() * sparse.eye_array(matrix.shape[0], format="csc"))


def superlu(matrix: sparse.csc_array) -> float:
    """Time of one symbolic and numeric factorisation in symmetric mode."""
    options = {"SymmetricMode": True}
    return seconds(lambda: splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options))


def codes(model: ShapeModel, count: int) -> FloatArray:
    """Random codes (count, m) inside the bounds."""
    return np.random.default_rng(0).uniform(model.latents.lower, model.latents.upper, (count, model.latents.dimension))


def stages(model: ShapeModel, code: FloatArray) -> dict[str, float]:
    """Times of one request in process."""
    checked, inside = model.latents.codes([code.tolist()])
    shape = model.shape(checked[0], bool(inside[0]))
    encode = seconds(lambda: GLB(shape.vertices, model.faces))
    times = {**shape.seconds, "encode": encode}
    return {**times, "sum": sum(times.values()), "iterations": shape.diagnostics.iterations}


def in_process(path: Path, count: int) -> list[str]:
    """Rows of the table for one bundle."""
    began = time.perf_counter()
    model = ShapeModel(read_bundle(path))
    loaded = time.perf_counter() - began
    drawn = codes(model, count + 1)
    cold = stages(model, drawn[0])
    warm = [stages(model, code) for code in drawn[1:]]
    median = {stage: statistics.median(times[stage] for times in warm) for stage in cold}
    found = model.shape(model.latents.codes([drawn[1].tolist()])[0][0])
    matrix = normal_matrix(model, found.vertices / model.manifest.scale)
    yardstick = statistics.median(superlu(matrix) for _ in range(5))
    title = f"{model.manifest.name}/{model.manifest.version}"
    print(f"{title}: V = {model.manifest.vertices}, loaded in {1e3 * loaded:.0f} ms", file=sys.stderr)
    rows = []
    for kind, times in (("cold", cold), ("warm", median)):
        network, reconstruct, encode, total = (
            f"{1e3 * times[stage]:.1f}" for stage in ("network", "reconstruct", "encode", "sum")
        )
        iterations, ratio = f"{times['iterations']:g}", f"{times['sum'] / yardstick:.2f}"
        cells = [title, kind, network, f"{reconstruct} ({iterations})", encode, total, f"{1e3 * yardstick:.1f}", ratio]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


@contextmanager
def server(models: Path) -> Iterator[tuple[httpx.Client, float]]:
    """A server process of its own with a client, and the time from its start until it was ready."""
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "service"],
        env={**os.environ, "SHAPESPACE_MODELS_DIR": str(models), "SHAPESPACE_PORT": "0"},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        address = re.search(r"http://\S+", process.stdout.readline() if process.stdout else "")
        if address is None:
            raise SystemExit("the server did not start")
        with httpx.Client(base_url=address.group(), timeout=120) as client:
            yield client, time.perf_counter() - began
    finally:
        process.terminate()
        process.communicate()


def over_http(client: httpx.Client, model: ShapeModel, count: int) -> str:
    """Row of the second table for one model."""
    path = f"/v1/models/{model.manifest.name}/mesh"
    drawn = codes(model, count + 1).tolist()

    def request(code: list[float]) -> float:
        return seconds(lambda: client.post(path, json={"latent": code}).raise_for_status())

    first = request(drawn[0])
    times = sorted(request(code) for code in drawn[1:])
    quantiles = [np.quantile(times, q) for q in (0.5, 0.95, 0.99)]
    cells = " | ".join(f"{1e3 * value:.1f}" for value in (first, *quantiles))
    return f"| {model.manifest.name} | {cells} |"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder of bundles")
    parser.add_argument("--count", type=int, default=30, help="codes for each median")
    arguments = parser.parse_args()
    found = (path.parent for path in arguments.models.glob("*/*/manifest.json"))
    paths = sorted(found, key=lambda path: (path.parent.name, int(path.name)))

    with threadpool_limits(1):
        rows = [row for path in paths for row in in_process(path, arguments.count)]
    print("\nIn process, one thread, ms; in brackets the iterations of Gauss–Newton.\n")
    print("| model | | network | reconstruct | encode | sum | SuperLU | sum / SuperLU |")
    print("|---|---|---|---|---|---|---|---|")
    print("\n".join(rows))
    with server(arguments.models) as (client, ready):
        newest = {path.parent.name: ShapeModel(read_bundle(path)) for path in paths}
        print(f"\nOver HTTP, one client, ms; ready {ready:.1f} s after the start of the process.\n")
        print("| model | first | p50 | p95 | p99 |")
        print("|---|---|---|---|---|")
        for model in newest.values():
            print(over_http(client, model, arguments.count))


if __name__ == "__main__":
    main()
