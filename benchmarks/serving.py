"""Cost of a request, by stage and in total: ``python -m benchmarks.serving [stages starts growth http]``.

Prints Markdown tables; ``--page`` writes them to docs/measurements/serving.md, without ``starts``. ``stages``,
``starts`` and ``growth`` run in this process on one thread and count its processor seconds, so that other programs
matter little. They alternate with three references. One SuperLU factorisation of the model's own Gauss–Newton matrix
makes machines comparable. Linear blend shapes (a sum of m fields and the same file) are a lower bound. The exact
exponential, for collections with a tangent space, is an upper bound. ``http`` measures a server process by the clock.
"""

import argparse
import io
import os
import statistics
import sys
import tempfile
import time
import unittest.mock
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import onnxruntime
from threadpoolctl import threadpool_limits

import shapespace
from benchmarks import pages, synthetic
from benchmarks.bundles import bundles, draw, normal_matrix, superlu
from benchmarks.http_requests import http
from benchmarks.pages import table
from benchmarks.processes import resident
from shapespace.arrays import FloatArray
from shapespace.bundle.reader import read_bundle
from shapespace.coordinates.reconstruction import Reconstruction, Reconstructor
from shapespace.files.formats import MESH_FORMATS
from shapespace.mesh.rigid_motion import align
from shapespace.model.decoder import TOLERANCE, MeshChoice
from shapespace.model.exact_shapes import exact_shape
from shapespace.model.latent_space import Codes
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.space import ShellSpace
from shapespace.solve.outcome import Status
from shapespace.training.collection.generators import freaky_torus

GLB = MESH_FORMATS["glb"].encode
#: Largest number of coarse vertices at which LAPACK's banded solver is also measured.
BANDED = 5000
PAGE = """# Serving

How long does the server take for a shape, and how does the time grow? Times are milliseconds of [CPU
time](../reference/glossary.md#cpu-time) on one thread, as medians over {count} codes, unless a table says otherwise.
"""
END = """
## How it was measured

`python -m benchmarks.serving --page` measures and writes this page. Measured on {day} with the code after
version {version}. The notes say [why the server is fast](../../benchmarks/NOTES.md#why-the-server-is-fast).
"""
#: Numbers of codes that a graph takes at once.
BATCHES = (1, 8, 64)
#: Two results of one code agree up to this fraction of the diagonal.
AGREEMENT = 1e-4


@contextmanager
def without_mkl() -> Iterator[None]:
    """Solve by LAPACK in objects created here, as on platforms without MKL wheels."""
    missing: dict[str, object] = {"pypardiso": None}
    with unittest.mock.patch.dict(sys.modules, missing):
        yield


def measure(path: Path, model: ShapeModel, codes: Codes) -> dict[str, list[float]]:
    """Return times of code → GLB by stage for a bundle's model, and of the references, measured in turn."""
    fine = model.mesh(MeshChoice.FINE)
    shape = model.shape(codes[0], mesh=MeshChoice.COARSE)
    yardstick = superlu(normal_matrix(model, shape.vertices / model.manifest.scale))
    fields = np.random.default_rng(1).standard_normal((model.latents.dimension, 3 * len(fine.vertices)))
    with without_mkl():
        plain = ShapeModel(read_bundle(path)) if model.manifest.vertices <= BANDED else None
    times: dict[str, list[float]] = {}
    for code in codes:

        def blend(code: FloatArray = code) -> object:
            return GLB(fine.vertices + (code @ fields).reshape(-1, 3), fine.faces, None)

        network = seconds(partial(model.decoder._networks, code[None]))
        began = time.thread_time()
        shape = model.shape(code)
        solved = time.thread_time() - began
        full, draft = (seconds(partial(model.shape, code, quality=q)) for q in (Quality.FULL, Quality.DRAFT))
        encode = seconds(partial(GLB, shape.vertices, fine.faces, None))
        found = {
            "network": network,
            "reconstruct": solved - network,
            "encode": encode,
            "sum": solved + encode,
            "full": full + encode,
            "draft": draft + encode,
            "iterations": shape.diagnostics.iterations,
            "blend shapes": seconds(blend),
        }
        if plain:
            with without_mkl():
                found["without MKL"] = seconds(partial(plain.shape, code)) + encode
        if len(times.get("SuperLU", ())) < 5 or found["sum"] > times["SuperLU"][-1] / 10:
            found["SuperLU"] = seconds(yardstick)  # for large meshes, only five
        for name, value in found.items():
            times.setdefault(name, []).append(value)
    return times


def away(model: ShapeModel, codes: Codes) -> list[float]:
    """Return largest vertex distances from a solution of tolerance 1e-10, in millionths of the diagonal."""
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
    """Print times by stage, for every bundle in some folders."""
    medians: dict[str, dict[str, float]] = {}
    late: dict[str, float] = {}
    limits: list[float] = []
    own: list[list[str]] = []
    batches: list[list[str]] = []
    tails: list[list[str]] = []
    beside: list[list[str]] = []
    exact: list[list[str]] = []
    for path, is_fold in ((path, folder != folders[0]) for folder in folders for path in bundles(folder)):
        model = ShapeModel(read_bundle(path))
        codes = draw(model, count + 3)
        times = measure(path, model, codes)
        median = {name: statistics.median(values[3:]) for name, values in times.items()}
        distances = away(model, codes)
        name = f"{model.manifest.name}{' (a fold)' if is_fold else ''}, V = {model.manifest.vertices}"
        medians[name] = median
        exact.append([name, *to_exact(model, codes)])
        steps = statistics.mean(times["iterations"][3:])
        quantiles = " / ".join(ms(float(np.quantile(times["sum"][3:], q))) for q in (0.5, 0.95, 0.99))
        late[name] = float(np.quantile(times["sum"][3:], 0.95)) / median["sum"]
        if limit := ceiling(model, codes[:5]):
            limits.append(limit / median["sum"])
        solved = f"{ms(median['reconstruct'])} ({steps:.1f})"
        own.append([name, ms(median["network"]), solved, ms(median["encode"]), ms(median["sum"])])
        others = f"{ms(median['full'])} / {ms(median['draft'])}"
        tails.append([name, quantiles, others, f"{median['without MKL'] / median['sum']:.2f}"])
        shares = " / ".join(f"{median[key] / median['SuperLU']:.2f}" for key in ("sum", "full", "draft"))
        if found := graph(model, codes[3:]):
            batches.append([name, *found])
        furthest = f"{statistics.median(distances):.1f}, {max(distances):.1f}"
        beside.append([name, ms(median["blend shapes"]), ms(limit) if limit else "–", shares, furthest])
    sums, slowest = [each["sum"] for each in medians.values()], max(late, key=lambda name: late[name])
    print("\n## A shape as a file\n")
    print(f"A shape takes {ms(min(sums))} to {ms(max(sums))} ms, by model. Reconstruction takes most of the time.")
    print(f"For {slowest}, one code in twenty takes at least {late.pop(slowest):.1f} times the median.", end="")
    print(f" For the others it is at most {max(late.values()):.1f} times.\n" if late else "\n")
    print(table(("", "p50 / p95 / p99", "full / draft", "without MKL ÷ p50"), tails))
    print("\nA code becomes a GLB of the fine mesh, with [quality](../reference/http.md#quality) `auto`. V is the")
    print("number of coarse vertices. Without [MKL](../reference/glossary.md#blas-mkl), LAPACK solves.")
    if len(folders) > 1:
        print("A *fold* is a model without a fifth of the shapes, as for [unseen shapes](served.md).")
    print("\nShapes of quality `auto` are as close to the exact exponential as full shapes.\n")
    print(table(("mean distance, 1e-4 of the diagonal", "auto", "full", "draft"), exact))
    print("\nBrackets have the ratio to full shapes. For Freaky Torus, the exact shape comes from its formula. Models")
    print("with a dash are straight lines of rotations and stretches, which have no exact exponential.")
    if batches:
        print("\nThe graph `decoder.onnx` gives the vertices of drafts in batches.\n")
        print(table(("code → vertices, one graph", *(f"batch of {size}" for size in BATCHES), "full / draft"), batches))
        print("\nTimes are for one shape, without a file. All columns are from one run, in turn.")
    least = [each["sum"] / each["blend shapes"] for each in medians.values()]
    print(f"\nA shape takes {min(least):.0f} to {max(least):.0f} times as long as the same file from blend shapes.")
    if limits:
        print("An [exact shape](../reference/glossary.md#exponential) takes")
        print(f"up to {max(limits):.0f} times as long as a shape.")
    # The other tables are for developers.
    print(table(("model", "networks", "reconstruction (steps)", "file", "sum"), own), file=sys.stderr)
    print(table(("", "blend shapes", "exact shape", "auto / full / draft, ÷ SuperLU", "away"), beside), file=sys.stderr)
    print("Away: from a solution of tolerance 1e-10, in millionths of the diagonal: median, largest.", file=sys.stderr)


def to_exact(model: ShapeModel, codes: Codes) -> list[str]:
    """Return the mean distance of each quality from exact coarse shapes; dashes without exact shapes."""
    size, away = model.manifest.scale * model.reference.diagonal, dict[Quality, list[float]]()
    for code in codes:
        if model.manifest.name == "freaky-torus":
            true: FloatArray | None = freaky_torus.vertices(code[None].astype(np.float64))[0]
        elif model.decoder.modes is None:
            return ["–"] * len(Quality)
        else:
            zeros = np.zeros(model.reference.vertices.shape, np.float32)
            found = exact_shape(model.decoder, code, zeros, MeshChoice.COARSE).vertices
            true = None if found is None else found.astype(np.float64)
        for quality in Quality:
            shape = model.shape(code, mesh=MeshChoice.COARSE, quality=quality).vertices
            if true is not None:
                distance = np.linalg.norm(align(shape, true) - true, axis=1).mean() / size
                away.setdefault(quality, []).append(float(distance))
    mean = {quality: statistics.mean(values) for quality, values in away.items()}
    return [f"{1e4 * mean[q]:.2f} ({mean[q] / mean[Quality.FULL]:.3f})" for q in Quality]


def graph(model: ShapeModel, codes: Codes) -> list[str]:
    """Return times of a shape by ``decoder.onnx`` in batches, beside a draft and a full shape; [] without the file."""
    entry = model.manifest.decoder
    if entry is None:
        return []
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.folder / entry.file, options, providers=["CPUExecutionProvider"])
    times: dict[int | Quality, list[float]] = {}
    for first in range(len(codes)):
        for size in BATCHES:
            batch = np.take(codes, range(first, first + size), axis=0, mode="wrap")
            spent = seconds(partial(session.run, [entry.vertices], {entry.input: batch}))
            times.setdefault(size, []).append(spent / size)
        for quality in (Quality.DRAFT, Quality.FULL):
            times.setdefault(quality, []).append(seconds(partial(model.shape, codes[first], quality=quality)))
    median = {key: ms(statistics.median(values)) for key, values in times.items()}
    return [*(median[size] for size in BATCHES), f"{median[Quality.FULL]} / {median[Quality.DRAFT]}"]


def ceiling(model: ShapeModel, codes: Codes) -> float | None:
    """Return the time of the exact exponential, if the model has modes."""
    facts = model.manifest
    if model.decoder.modes is None or facts.exponential_steps is None:
        return None
    material = Material(facts.mu, facts.lambda_, facts.eta)
    space = ShellSpace(model.reference, material, first_step=facts.exponential_first_step)
    velocities = [np.tensordot(code.astype(np.float64), model.decoder.modes, 1) for code in codes]
    start, steps = model.reference.vertices, facts.exponential_steps
    return statistics.median(seconds(partial(exponential, space, start, v, steps)) for v in velocities)


def starts(models: Path, count: int) -> None:
    """Print Gauss–Newton steps by start, and whether all starts of a code end in one shape."""
    found: list[list[str]] = []
    for path in bundles(models):
        model = ShapeModel(read_bundle(path))
        for spread in (1.0, 1.5):
            name = f"{model.manifest.name} × {spread:g}"
            found.append([name, *_starts(model, draw(model, count, spread))])
    print("\n## Starts of the reconstruction\n")
    print("Inside the bounds all starts end in the same shape, and ours needs the least time.\n")
    print(table(("model, bounds", "ours", "frames, neighbour", "learned, reference", "ends apart"), found))
    print("\nSteps, and in brackets milliseconds. *Frames* integrates lengths and angles along a tree of faces, and")
    print(
        "*learned* asks a network. *Neighbour* is a shape a tenth of the bounds away. *Ends apart*: codes at which two"
    )
    print(f"results differ by more than {AGREEMENT:g} of the diagonal.")


def _starts(model: ShapeModel, codes: Codes) -> list[str]:
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
        # The product does not start from frames alone; it checks them first.
        others = (result.vertices for name, result in found.items() if name != "frames")
        distance = max(np.abs(align(other, ours) - ours).max() for other in others)
        apart += bool(distance > AGREEMENT * model.reference.diagonal)

    def cell(name: str) -> str:
        if name not in spent:
            return "–"
        steps, times = zip(*spent[name], strict=True)
        return f"{statistics.mean(steps):.1f} ({1e3 * statistics.median(times):.0f})"

    said = ", ".join(f"{count} {status}" for status, count in statuses.items() if count)
    pairs = [", ".join(map(cell, pair)) for pair in (("frames", "neighbour"), ("learned", "reference"))]
    return [cell("ours"), *pairs, f"{apart} of {len(codes)}; {said}"]


def growth(count: int) -> None:
    """Print the growth of times with the number of vertices and with the dimension."""
    print("\n## Growth")
    largest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for kind, cases in (
            ("V", [(v, 20) for v in (500, 1000, 2000, 5000, 10_000, 20_000, 50_000)]),
            ("m", [(1000, m) for m in (4, 20, 40, 80)]),
        ):
            found, sizes, sums = [], [], []
            for vertices, latents in cases:
                path = synthetic.write(Path(folder) / kind, vertices, latents)
                model = ShapeModel(read_bundle(path))
                times = measure(path, model, draw(model, count + 2))
                median = {name: statistics.median(values[2:]) for name, values in times.items()}
                steps = statistics.mean(times["iterations"][2:])
                sizes.append(vertices if kind == "V" else latents)
                sums.append(median["sum"])
                largest = max(largest, resident(os.getpid()))
                size = str(model.manifest.vertices if kind == "V" else latents)
                found.append([size, ms(median["sum"]), f"{steps:.1f}"])
            if kind == "V":
                print("\nTime grows faster than the number of coarse vertices V: larger meshes need more steps too.")
                print("The number m of modes makes almost no difference.\n")
                print(table((kind, "time", "steps of [Gauss–Newton](../reference/glossary.md#gaussnewton)"), found))
                print()
            power = np.polyfit(np.log(sizes), np.log(sums), 1)[0]
            print(f"From {kind} = {sizes[0]} to {sizes[-1]}, the time grows like {kind}^{power:.2f}.")
    print(f"The shapes are synthetic capsules. The process took at most {largest:.0f} MB, for the largest V.")


def ms(seconds: float) -> str:
    """Return a cell in milliseconds."""
    return f"{1e3 * seconds:.1f}"


def seconds(work: Callable[[], object]) -> float:
    """Return the processor time of one call on this thread."""
    began = time.thread_time()
    work()
    return time.thread_time() - began


def main() -> None:
    """Measure and print, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("stages", "growth", "http")
    parser.add_argument("parts", nargs="*", choices=[*parts, "starts", []], default=[], help="default: all but starts")
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
    day = f"{datetime.now(UTC):%Y-%m-%d}"
    end = END.format(day=day, version=shapespace.__version__)
    pages.write("serving", PAGE.format(count=arguments.count) + text.getvalue() + end)


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
