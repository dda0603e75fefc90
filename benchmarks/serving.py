"""Cost of a request, by stage and in total: ``python -m benchmarks.serving [stages starts growth http]``.

Prints Markdown tables; ``--page`` writes them all to docs/measurements/serving.md. ``stages``, ``starts`` and
``growth`` run in this process on one thread and count its processor seconds, so that other programs matter little.
They alternate with three references. One SuperLU factorisation of the model's own Gauss–Newton matrix makes machines
comparable. Linear blend shapes (a sum of m fields and the same file) are a lower bound. The exact exponential, for
collections with a tangent space, is an upper bound. ``http`` measures a server process by the clock.
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
from scipy import sparse
from threadpoolctl import threadpool_limits

from benchmarks import pages, synthetic
from benchmarks.bundles import bundles, draw, superlu
from benchmarks.http_requests import http
from benchmarks.pages import print_head, print_row
from benchmarks.processes import resident
from shapespace.arrays import FloatArray
from shapespace.bundle.reader import read_bundle
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

GLB = MESH_FORMATS["glb"].encode
#: Largest number of coarse vertices at which LAPACK's banded solver is also measured.
BANDED = 5000
PAGE = """# Serving

`python -m benchmarks.serving --page` measures and writes this page. In process: on one thread, in processor seconds of
that thread. *SuperLU* is one factorisation (symmetric mode) of the model's own normal matrix, run in turn. *Blend
shapes* is a sum of m fields and the same file, the floor; the *exponential* is what networks stand for, the ceiling.
[performance.md](performance.md) has the aims, and why it is as fast as it is. Measured on
{day:%Y-%m-%d}; models may have been trained anew since.
"""
#: Two results of one code agree up to this fraction of the diagonal.
AGREEMENT = 1e-4


def normal_matrix(model: ShapeModel, vertices: FloatArray) -> sparse.csr_array:
    """Return ``JᵀWJ`` at a normalised shape."""
    weights = WeightedNorm.of(model.reference, model.manifest.eta_reconstruction).squared
    jacobian = NRICJacobian(model.reference.connectivity)(vertices)
    return sparse.csr_array(jacobian.T @ sparse.diags_array(weights) @ jacobian)


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
    print("\nCode → GLB of the fine mesh in process, ms, medians; in brackets steps of Gauss–Newton. *Without")
    print("MKL*: multiple of the sum. *Away*: the furthest vertex from a solution of tolerance 1e-10, in")
    print("millionths of the diagonal, median and most over the codes.\n")
    print_head(
        "model | network | reconstruct | encode | sum | p95 | p99 | draft | SuperLU | sum / SuperLU | "
        "draft / SuperLU | without MKL | away | blend shapes | exponential, K = 16"
    )
    for path in (path for folder in folders for path in bundles(folder)):
        model = ShapeModel(read_bundle(path))
        codes = draw(model, count + 3)
        times = measure(path, model, codes)
        median = {name: statistics.median(values[3:]) for name, values in times.items()}
        distances = away(model, codes)
        print_row(
            f"{model.manifest.name}, V = {model.manifest.vertices}",
            median["network"],
            f"{1e3 * median['reconstruct']:.1f} ({statistics.mean(times['iterations'][3:]):.1f})",
            median["encode"],
            median["sum"],
            *(float(np.quantile(times["sum"][3:], q)) for q in (0.95, 0.99)),
            median["draft"],
            median["SuperLU"],
            *(f"{median[name] / median['SuperLU']:.2f}" for name in ("sum", "draft")),
            f"{median['without MKL'] / median['sum']:.2f}",
            f"{statistics.median(distances):.1f}, {max(distances):.1f}",
            median["blend shapes"],
            ceiling(model, codes[:5]),
        )


def ceiling(model: ShapeModel, codes: Codes) -> float | str:
    """Return the time of the exact exponential, if the model has modes."""
    facts = model.manifest
    if model.decoder.modes is None or facts.exponential_steps is None:
        return "–"
    space = ShellSpace(model.reference, Material(facts.mu, facts.lambda_, facts.eta))
    velocities = [np.tensordot(code.astype(np.float64), model.decoder.modes, 1) for code in codes]
    start, steps = model.reference.vertices, facts.exponential_steps
    return statistics.median(seconds(partial(exponential, space, start, v, steps)) for v in velocities)


def starts(models: Path, count: int) -> None:
    """Print Gauss–Newton steps by start, and whether all starts of a code end in one shape."""
    print(f"\nSteps (processor ms) by start, and codes at which two results are more than {AGREEMENT:g} of the")
    print("diagonal apart; `ours` is what the product does. The neighbour is a shape a tenth of the box away.\n")
    print_head("model, box | ours | frames | learned | neighbour | reference | codes | apart | status")
    for path in bundles(models):
        model = ShapeModel(read_bundle(path))
        for spread in (1.0, 1.5):
            print_row(f"{model.manifest.name} × {spread:g}", *_starts(model, draw(model, count, spread)))


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
        # The product does not start from frames alone; it checks them first.
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
    """Print the growth of times with the number of vertices and with the dimension."""
    with tempfile.TemporaryDirectory() as folder:
        for kind, cases in (
            ("V", [(v, 20) for v in (500, 1000, 2000, 5000, 10_000, 20_000, 50_000)]),
            ("m", [(1000, m) for m in (4, 20, 40, 80)]),
        ):
            print(f"\nSynthetic capsules, growing {kind}; medians, ms. *Factor*: one of Gauss–Newton.\n")
            print_head(
                "V | m | network | reconstruct (steps) | factor | encode | sum | SuperLU | sum / SuperLU | "
                "blend shapes | MB"
            )
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
                print_row(
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
    """Return the time of one Gauss–Newton factorisation, at the reference."""
    target = nric(model.reference.vertices, model.reference.connectivity)
    with model.decoder.solver() as reconstruct:
        point = reconstruct._squares(model.reference.vertices, target)
        return statistics.median(seconds(lambda: reconstruct.solver.factor(point, target)) for _ in range(5))


def seconds(work: Callable[[], object]) -> float:
    """Return the processor time of one call on this thread."""
    began = time.thread_time()
    work()
    return time.thread_time() - began


def main() -> None:
    """Measure and print, or write the page."""
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
    page = PAGE.format(day=datetime.now(UTC))
    pages.write("serving", page + text.getvalue())


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
