"""What a request costs, by stage and as a whole: ``python -m benchmarks.serving [stages starts growth http]``.

Prints Markdown tables; ``--page`` writes them all as docs/measurements/serving.md. ``stages``, ``starts`` and
``growth`` run in this process on one thread and count its processor seconds, so that other programs on the machine
matter little. Beside them, turn by turn, stand one SuperLU factorisation of the model's own Gauss–Newton matrix, which
is the yardstick that travels between machines, and what one would run otherwise: linear blend shapes (a sum of m fields
and the same file), which are the floor, and for collections with a tangent space the exact exponential, which is the
ceiling. ``http`` asks a server process of its own, by the clock.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import unittest.mock
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import httpx
import numpy as np
from scipy import sparse
from threadpoolctl import threadpool_limits

from benchmarks import synthetic
from benchmarks.yardstick import superlu
from shapespace.arrays import FloatArray
from shapespace.bundle.reader import read_bundle
from shapespace.coordinates import compiled
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm, nric
from shapespace.coordinates.reconstruction import Reconstruction, Reconstructor
from shapespace.files.formats import MESH_FORMATS
from shapespace.mesh.rigid_motion import align
from shapespace.model.decoder import TOLERANCE, MeshChoice, Quality
from shapespace.model.latent_space import Codes
from shapespace.model.shape_model import ShapeModel
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.space import ShellSpace
from shapespace.solve.outcome import Status

ROOT = Path(__file__).resolve().parents[1]
GLB = MESH_FORMATS["glb"].encode
#: Largest number of coarse vertices at which LAPACK's banded solver is measured too.
BANDED = 5000
PAGE = """# Serving

`python -m benchmarks.serving --page` measures and writes this page. In process: on one thread, in processor seconds of
that thread. *SuperLU* is one factorisation (symmetric mode) of the model's own normal matrix, run in turn. *Blend
shapes* is a sum of m fields and the same file, the floor; the *exponential* is what networks stand for, the ceiling.
[performance.md](performance.md) has the aims, and why it is as fast as it is. Everything but the column *without Numba*
was measured {kernels} Numba, on {day:%Y-%m-%d}; models may have been trained anew since.
"""
#: Two results of one code agree up to this fraction of the diagonal.
AGREEMENT = 1e-4


def seconds(work: Callable[[], object]) -> float:
    """Processor time of one call on this thread."""
    began = time.thread_time()
    work()
    return time.thread_time() - began


def table(*columns: str) -> None:
    """The head of a Markdown table."""
    row(*columns)
    print("|" + "---|" * len(columns))


def row(*cells: object) -> None:
    """One of its rows; times are in ms."""
    print(
        f"| {' | '.join(f'{1e3 * cell:.1f}' if isinstance(cell, float) else str(cell) for cell in cells)} |", flush=True
    )


def normal_matrix(model: ShapeModel, vertices: FloatArray) -> sparse.csr_array:
    """``JᵀWJ`` at a normalised shape."""
    weights = WeightedNorm.of(model.reference, model.manifest.eta_reconstruction).squared
    jacobian = NRICJacobian(model.reference.connectivity)(vertices)
    return sparse.csr_array(jacobian.T @ sparse.diags_array(weights) @ jacobian)


def draw(model: ShapeModel, count: int, spread: float = 1.0) -> Codes:
    """Random codes (count, m) in a box so many times as wide as the bounds."""
    centre = (model.latents.lower + model.latents.upper) / 2
    radius = spread * (model.latents.upper - model.latents.lower) / 2
    codes = centre + radius * np.random.default_rng(0).uniform(-1, 1, (count, len(centre)))
    return model.latents.codes(codes.tolist())[0]


def bundles(folder: Path) -> list[Path]:
    """Folders of bundles, by name and version."""
    found = (path.parent for path in folder.glob("*/*/manifest.json"))
    return sorted(found, key=lambda path: (path.parent.name, int(path.name)))


@contextmanager
def without_mkl() -> Iterator[None]:
    """As where MKL has no wheel: what is made here solves by LAPACK."""
    missing: dict[str, object] = {"pypardiso": None}
    with unittest.mock.patch.dict(sys.modules, missing):
        yield


@contextmanager
def without_numba() -> Iterator[None]:
    """As where Numba isn't installed: what is made here computes by NumPy."""
    with unittest.mock.patch.object(compiled, "AVAILABLE", False):
        yield


def measure(path: Path, model: ShapeModel, codes: Codes) -> dict[str, list[float]]:
    """Times of code → GLB by stage, and of the yardsticks in turn with them; of the model of a bundle."""
    fine = model.mesh(MeshChoice.FINE)
    shape = model.shape(codes[0], mesh=MeshChoice.COARSE)
    yardstick = superlu(normal_matrix(model, shape.vertices / model.manifest.scale))
    fields = np.random.default_rng(1).standard_normal((model.latents.dimension, 3 * len(fine.vertices)))
    with without_mkl():
        plain = ShapeModel(read_bundle(path)) if model.manifest.vertices <= BANDED else None
    with without_numba():
        numpy = ShapeModel(read_bundle(path))
    times: dict[str, list[float]] = {}
    for code in codes:

        def blend(code: FloatArray = code) -> object:
            return GLB(fine.vertices + (code @ fields).reshape(-1, 3), fine.faces, None)

        network = seconds(partial(model.decoder._networks, code[None]))
        began = time.thread_time()
        shape = model.shape(code)
        solved = time.thread_time() - began
        draft = seconds(partial(model.shape, code, quality=Quality.DRAFT))
        encode = seconds(partial(GLB, shape.vertices, fine.faces, None))
        found = {
            "network": network,
            "reconstruct": solved - network,
            "encode": encode,
            "sum": solved + encode,
            "draft": draft + encode,
            "iterations": shape.diagnostics.iterations,
            "blend shapes": seconds(blend),
        }
        found["NumPy"] = seconds(partial(numpy.shape, code)) + encode
        if plain:
            with without_mkl():
                found["without MKL"] = seconds(partial(plain.shape, code)) + encode
        if len(times.get("SuperLU", ())) < 5 or found["sum"] > times["SuperLU"][-1] / 10:
            found["SuperLU"] = seconds(yardstick)  # of large meshes five have to do
        for name, value in found.items():
            times.setdefault(name, []).append(value)
    return times


def away(model: ShapeModel, codes: Codes) -> list[float]:
    """How far shapes end from a solution of tolerance 1e-10: the furthest vertex, in millionths of the diagonal."""
    found = []
    with model.decoder.solver() as reconstruct:
        for code in codes:
            target, others = model.decoder._networks(code[None])[1][0], list(model.decoder._learned_start(code))
            ours, exact = (reconstruct.from_guess(target, *others, tolerance=t).vertices for t in (TOLERANCE, 1e-10))
            found.append(
                1e6 * float(np.linalg.norm(align(ours, exact) - exact, axis=1).max()) / model.reference.diagonal
            )
    return found


def stages(folders: list[Path], count: int) -> None:
    """Stage by stage, for every bundle of some folders."""
    print("\nCode → GLB of the fine mesh in process, ms, medians; in brackets steps of Gauss–Newton. *Without MKL* and")
    print("*without Numba*: multiples of the sum. *Away*: the furthest vertex from a solution of tolerance 1e-10, in")
    print("millionths of the diagonal, median and most over the codes.\n")
    columns = (
        "network",
        "reconstruct",
        "encode",
        "sum",
        "p95",
        "p99",
        "draft",
        "SuperLU",
        "sum / SuperLU",
        "draft / SuperLU",
        "without MKL",
        "without Numba",
        "away",
        "blend shapes",
    )
    table("model", *columns, "exponential, K = 16")
    for path in (path for folder in folders for path in bundles(folder)):
        model = ShapeModel(read_bundle(path))
        codes = draw(model, count + 3)
        times = measure(path, model, codes)
        median = {name: statistics.median(values[3:]) for name, values in times.items()}
        distances = away(model, codes)
        row(
            f"{model.manifest.name}, V = {model.manifest.vertices}",
            median["network"],
            f"{1e3 * median['reconstruct']:.1f} ({statistics.mean(times['iterations'][3:]):.1f})",
            median["encode"],
            median["sum"],
            *(float(np.quantile(times["sum"][3:], q)) for q in (0.95, 0.99)),
            median["draft"],
            median["SuperLU"],
            *(f"{median[name] / median['SuperLU']:.2f}" for name in ("sum", "draft")),
            *(f"{median[name] / median['sum']:.2f}" for name in ("without MKL", "NumPy")),
            f"{statistics.median(distances):.1f}, {max(distances):.1f}",
            median["blend shapes"],
            ceiling(model, codes[:5]),
        )


def ceiling(model: ShapeModel, codes: Codes) -> float | str:
    """Time of the exact exponential, where the model has modes."""
    facts = model.manifest
    if model.decoder.modes is None or facts.exponential_steps is None:
        return "–"
    space = ShellSpace(model.reference, Material(facts.mu, facts.lambda_, facts.eta))
    velocities = [np.tensordot(code.astype(np.float64), model.decoder.modes, 1) for code in codes]
    start, steps = model.reference.vertices, facts.exponential_steps
    return statistics.median(seconds(partial(exponential, space, start, v, steps)) for v in velocities)


def starts(models: Path, count: int) -> None:
    """Steps of Gauss–Newton by start, and whether all starts of a code end in one shape."""
    print(f"\nSteps (processor ms) by start, and codes at which two results are more than {AGREEMENT:g} of the")
    print("diagonal apart; `ours` is what the product does. The neighbour is a shape a tenth of the box away.\n")
    table("model, box", "ours", "frames", "learned", "neighbour", "reference", "codes", "apart", "status")
    for path in bundles(models):
        model = ShapeModel(read_bundle(path))
        for spread in (1.0, 1.5):
            row(f"{model.manifest.name} × {spread:g}", *_starts(model, draw(model, count, spread)))


def _starts(model: ShapeModel, codes: Codes) -> list[object]:
    reconstruct = Reconstructor(model.reference, model.manifest.eta_reconstruction)
    radius = 0.1 * (model.latents.upper - model.latents.lower) / 2
    rng = np.random.default_rng(1)
    spent: dict[str, list[tuple[int, float]]] = {}
    apart, statuses = 0, dict.fromkeys(Status, 0)
    for code in codes:
        target = model.decoder._networks(code[None])[1][0]
        near = (code + radius * rng.uniform(-1, 1, len(code))).astype(np.float32)
        beside = model.decoder._networks(near[None])[1][0]
        learned = list(model.decoder._learned_start(code))
        neighbour = reconstruct(beside, reconstruct.guess(beside), tolerance=TOLERANCE).vertices
        starts: dict[str, Callable[[], FloatArray]] = {
            "frames": partial(reconstruct.integrate, target),
            "reference": lambda: model.reference.vertices,
            **dict(zip(["learned"], learned, strict=False)),
            "neighbour": neighbour.copy,
        }
        found: dict[str, Reconstruction] = {}
        for name in ("ours", *starts):
            began = time.thread_time()
            if name == "ours":
                found[name] = reconstruct.from_guess(target, *learned, tolerance=TOLERANCE)
            else:
                found[name] = reconstruct(target, starts[name](), tolerance=TOLERANCE)
            spent.setdefault(name, []).append((found[name].iterations, time.thread_time() - began))
        statuses[found["ours"].status] += 1
        ours = found["ours"].vertices
        # Frames by themselves are no start of the product's: it looks whether they are any good.
        others = (result.vertices for name, result in found.items() if name != "frames")
        distance = max(np.abs(align(other, ours) - ours).max() for other in others)
        apart += bool(distance > AGREEMENT * model.reference.diagonal)

    def cell(name: str) -> str:
        if name not in spent:
            return "–"
        steps, times = zip(*spent[name], strict=True)
        return f"{statistics.mean(steps):.1f} ({1e3 * statistics.median(times):.0f})"

    names = "ours", "frames", "learned", "neighbour", "reference"
    said = ", ".join(f"{count} {status}" for status, count in statuses.items() if count)
    return [*map(cell, names), len(codes), apart, said]


def growth(count: int) -> None:
    """How times grow with the number of vertices and with the dimension."""
    with tempfile.TemporaryDirectory() as folder:
        for kind, cases in (
            ("V", [(v, 20) for v in (500, 1000, 2000, 5000, 10_000, 20_000, 50_000)]),
            ("m", [(1000, m) for m in (4, 20, 40, 80)]),
        ):
            print(f"\nSynthetic capsules, growing {kind}; medians, ms. *Factor*: one of Gauss–Newton.\n")
            columns = (
                "network",
                "reconstruct (steps)",
                "factor",
                "encode",
                "sum",
                "SuperLU",
                "sum / SuperLU",
                "blend shapes",
            )
            table("V", "m", *columns, "MB")
            sizes, sums, factors = [], [], []
            for vertices, latents in cases:
                path = synthetic.write(Path(folder) / kind, vertices, latents)
                model = ShapeModel(read_bundle(path))
                times = measure(path, model, draw(model, count + 2))
                median = {name: statistics.median(values[2:]) for name, values in times.items()}
                steps = statistics.mean(times["iterations"][2:])
                sizes.append(vertices if kind == "V" else latents)
                sums.append(median["sum"])
                factors.append(factor(model))
                row(
                    model.manifest.vertices,
                    latents,
                    median["network"],
                    f"{1e3 * median['reconstruct']:.1f} ({steps:.1f})",
                    factors[-1],
                    median["encode"],
                    median["sum"],
                    median["SuperLU"],
                    f"{median['sum'] / median['SuperLU']:.2f}",
                    median["blend shapes"],
                    f"{resident(os.getpid()):.0f}",
                )
            grown = {"The sum": sums, "one factor": factors, "the sum without one factor": np.subtract(sums, factors)}
            laws = [f"{name} as {kind}^{np.polyfit(np.log(sizes), np.log(y), 1)[0]:.2f}" for name, y in grown.items()]
            print(f"\n{', '.join(laws)} (least squares in logarithms). Memory is this process's, all sizes so far.")


def factor(model: ShapeModel) -> float:
    """Time of one factor of Gauss–Newton, of the reference."""
    target = nric(model.reference.vertices, model.reference.connectivity)
    with model.decoder.solver() as reconstruct:
        point = reconstruct._squares(model.reference.vertices, target)
        return statistics.median(seconds(lambda: reconstruct._factor(point, target)) for _ in range(5))


@contextmanager
def server(models: Path, **settings: object) -> Iterator[tuple[httpx.Client, int, float]]:
    """A server process of its own: a client, its process, and the time from its start until it was ready."""
    began = time.perf_counter()
    more = {f"SHAPESPACE_{name.upper()}": str(value) for name, value in settings.items()}
    process = subprocess.Popen(
        [sys.executable, "-m", "shapespace.service"],
        env={**os.environ, "SHAPESPACE_MODELS_DIR": str(models), "SHAPESPACE_PORT": "0", **more},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        address = re.search(r"http://\S+", process.stdout.readline() if process.stdout else "")
        if address is None:
            raise SystemExit("the server did not start")
        with httpx.Client(base_url=address.group(), timeout=120) as client:
            client.get("/v2/health/ready").raise_for_status()
            yield client, process.pid, time.perf_counter() - began
    finally:
        process.terminate()
        process.communicate()


def resident(pid: int) -> float:
    """Resident memory of a process in MB."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(re.findall(r"VmRSS:\s+(\d+)", text)[0]) / 1024


def processor(pid: int) -> float:
    """Processor seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def http(models: Path, count: int, duration: float) -> None:
    """End to end, from a server process, with one client and with sixteen."""
    names = {path.parent.name: ShapeModel(read_bundle(path)) for path in bundles(models)}
    with server(models, cache=0) as (client, pid, ready):
        used, memory = processor(pid), resident(pid)
        print(
            f"\nReady {ready:.1f} s ({used:.1f} processor s) after the start of the process; {memory:.0f} MB resident."
        )
        print(
            "\nOver HTTP, no cache: GLB of the fine mesh, ms by the clock, and processor ms of the server a request.\n"
        )
        table("model", "clients", "requests", "errors", "p50", "p95", "p99", "p99 / p50", "processor", "MB after")
        for name, model in names.items():
            for clients, limit in ((1, count), (16, 10**9)):
                began = processor(pid)
                times, errors = load(client, name, model, clients, limit, duration if clients > 1 else 1e9)
                spent = (processor(pid) - began) / len(times)
                quantiles = [float(np.quantile(times, q)) for q in (0.5, 0.95, 0.99)]
                ratio = f"{quantiles[2] / quantiles[0]:.1f}"
                row(name, clients, len(times), errors, *quantiles, ratio, spent, f"{resident(pid):.0f}")
        print("\nInterpolations of 60 frames, fine mesh, streamed as JSON lines and whole as GLB.\n")
        table(
            "model",
            "first line, ms",
            "one frame alone, ms",
            "frames / s",
            "frames / processor s",
            "GLB, frames / processor s",
        )
        for name, model in names.items():
            row(name, *interpolation(client, pid, name, model))


def load(
    client: httpx.Client, name: str, model: ShapeModel, clients: int, limit: int, duration: float
) -> tuple[list[float], int]:
    """Times of requests for codes never asked before, and how many failed."""
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


def interpolation(client: httpx.Client, pid: int, name: str, model: ShapeModel) -> list[object]:
    """Time to the first line, of a frame by itself, and rates."""
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
            next(chunk for chunk in answer.iter_raw() if chunk.endswith(b"\n"))
            first.append(time.perf_counter() - began)
        time.sleep(0.5)  # for the frames that were begun and that nobody waits for any more
    began, spent = time.perf_counter(), processor(pid)
    with client.stream("GET", links["jsonl"]) as answer:
        count = sum(1 for _ in answer.iter_lines())
    rate, per_second = count / (time.perf_counter() - began), count / (processor(pid) - spent)
    spent = processor(pid)
    client.get(links["glb"]).raise_for_status()
    whole = count / (processor(pid) - spent)
    return [statistics.median(first), statistics.median(alone), f"{rate:.0f}", f"{per_second:.0f}", f"{whole:.0f}"]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("stages", "starts", "growth", "http")
    parser.add_argument("parts", nargs="*", choices=[*parts, []], default=[], help="default: all")
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder of bundles")
    parser.add_argument("--more", type=Path, nargs="*", default=[], help="further ones, for stages only")
    parser.add_argument("--count", type=int, default=30, help="codes for each median")
    parser.add_argument("--seconds", type=float, default=60, help="how long sixteen clients ask")
    parser.add_argument("--page", action="store_true", help="write the page instead")
    arguments = parser.parse_args()
    arguments.parts = arguments.parts or parts
    if not arguments.page:
        run(arguments)
        return
    with redirect_stdout(io.StringIO()) as text:
        run(arguments)
    page = PAGE.format(kernels="with" if compiled.AVAILABLE else "without", day=datetime.now(UTC))
    (ROOT / "docs" / "measurements" / "serving.md").write_text(page + text.getvalue(), encoding="utf-8")


def run(arguments: argparse.Namespace) -> None:
    """Print the tables."""
    with threadpool_limits(1):
        if "stages" in arguments.parts:
            stages([arguments.models, *arguments.more], arguments.count)
        if "starts" in arguments.parts:
            starts(arguments.models, arguments.count)
        if "growth" in arguments.parts:
            growth(min(arguments.count, 10))
    if "http" in arguments.parts:
        http(arguments.models, arguments.count, arguments.seconds)


if __name__ == "__main__":
    main()
