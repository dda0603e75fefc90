"""docs/measurements/growth.md: processor seconds and memory of every training stage, by the size of the collection.

``python -m benchmarks.stages`` runs the real command, stage after stage, on capsules that bend and bulge, with one
size changed at a time. Results are kept under ``--out``.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import trimesh
from threadpoolctl import threadpool_limits

from benchmarks import pages
from benchmarks.pages import ROOT, table
from shapespace.arrays import FloatArray
from shapespace.bundle.reader import read_bundle
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Distribution
from shapespace.model.shape_model import ShapeModel
from shapespace.training.stages.run import STAGES

#: Number of joint exponentials and of exponentials of each factor, which determine the time; codes for each median.
JOINT, OF_FACTORS, CODES = 100, 50, 30

PAGE = """# How training grows

`python -m benchmarks.stages` writes this page: the real command on capsules that bend and bulge, with {joint} joint
exponentials and {factors} of each factor. The first row is the base; in each of the others one size is another:
vertices of the files, shapes n, modes m, or vertices of the coarse mesh. For each stage processor seconds, those of its
workers included and those of starting left out, of one run, with one BLAS thread; those of `samples` and `networks`
grow with the number of exponentials, which is 1000 and more in a real run. Memory is the largest resident set of a
process, of `ingest` and of whatever stage has most. The last two columns are of the model that comes out: processor
milliseconds of a shape on the coarse mesh, and what carrying the fine mesh along adds, medians over {codes} codes.
Measured on {day:%Y-%m-%d}; training may have changed since.

"""


@dataclass(frozen=True)
class Size:
    """Size of a collection and of its model."""

    fine: int = 10_000
    shapes: int = 20
    modes: int = 8
    coarse: int = 500


BASE = Size()
SIZES = [
    BASE,
    *(replace(BASE, fine=fine) for fine in (40_000, 160_000)),
    *(replace(BASE, shapes=shapes) for shapes in (40, 80)),
    *(replace(BASE, modes=modes) for modes in (4, 16)),
    *(replace(BASE, coarse=coarse) for coarse in (1000, 2000)),
    replace(BASE, fine=500_000),
]


def collection(size: Size) -> tuple[FloatArray, FloatArray]:
    """Return vertices (n, V, 3) and faces of random smooth deformations of a capsule."""
    count = round(np.sqrt(size.fine))
    mesh = trimesh.creation.capsule(height=3, radius=0.5, count=[count, count])
    rng, x = np.random.default_rng(0), np.asarray(mesh.vertices)
    waves = 1.5 * rng.standard_normal((2 * size.modes, 3))
    axes, phases = rng.standard_normal((2 * size.modes, 3)), rng.uniform(0, 6, 2 * size.modes)
    fields = np.sin(x @ waves.T + phases)[..., None] * axes
    weights = 0.08 * rng.standard_normal((size.shapes, 2 * size.modes)) / np.sqrt(size.modes)
    shapes = x + np.einsum("nk,vkd->nvd", weights, fields)
    return shapes.astype(np.float32), np.asarray(mesh.faces, np.int32)


def config(size: Size, data: Path) -> str:
    """Return the configuration of a run."""
    return f"""
[collection]
data = "{data}"
coarse_vertices = {size.coarse}
[modes]
count = {size.modes}
[samples]
count = {JOINT}
factor_counts = {OF_FACTORS}
part_size = 10
[evaluation]
reconstructions = 10
[export]
name = "capsules"
title = "Capsules"
description = "For a benchmark."
licence = "MIT"
"""


def measure(size: Size, folder: Path) -> dict[str, tuple[float, float]]:
    """Return for each stage processor seconds, including workers, and MB of the largest process."""
    folder.mkdir(parents=True, exist_ok=True)
    data, file = folder / "data.npz", folder / "config.toml"
    vertices, faces = collection(size)
    np.savez(data, vertices=vertices, faces=faces)
    file.write_text(config(size, data), encoding="utf-8")

    def until(stage: str) -> tuple[float, float]:
        where = ["--out", str(folder / "run"), "--models", str(folder), "--until", stage]
        command = [sys.executable, "-m", "shapespace.training", "run", str(file), *where]
        one_thread = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        child = subprocess.Popen(  # noqa: S603 - our own
            command, env=one_thread, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        _, status, used = os.wait4(child.pid, 0)
        if status:
            raise RuntimeError(f"{stage} of {size} ended with {os.waitstatus_to_exitcode(status)}")
        return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024

    found = {stage: until(stage) for stage in STAGES}
    # A call with nothing to do takes the time of starting and of reading the files.
    start = until("ingest")[0]
    data.unlink()
    return {stage: (max(seconds - start, 0.0), most) for stage, (seconds, most) in found.items()}


def serving(folder: Path) -> tuple[float, float]:
    """Return processor ms of a coarse shape of the bundle in a folder, and the further ms of its fine mesh."""
    model = ShapeModel(read_bundle(next(folder.glob("capsules/*"))))
    times: dict[MeshChoice, list[float]] = {choice: [] for choice in MeshChoice}
    for code in model.latents.sample(CODES + 3, 0, Distribution.UNIFORM):
        for choice, found in times.items():
            began = time.thread_time()
            model.shape(code, mesh=choice)
            found.append(1e3 * (time.thread_time() - began))
    fine, coarse = (float(np.median(times[choice][3:])) for choice in (MeshChoice.FINE, MeshChoice.COARSE))
    return coarse, fine - coarse


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "stages")
    given = parser.parse_args()
    shown = [stage for stage in STAGES if stage != "factors"]
    head = ["files' V", "n", "m", "coarse V", *shown, "ingest MB", "most MB", "shape ms", "fine mesh ms"]
    rows: list[list[str]] = []
    for size in SIZES:
        name = "-".join(map(str, asdict(size).values()))
        path = given.out / f"{name}.json"
        if not path.exists():
            measured = measure(size, given.out / name)
            with threadpool_limits(1):
                path.write_text(
                    json.dumps({"stages": measured, "serving": serving(given.out / name)}), encoding="utf-8"
                )
        kept = json.loads(path.read_text(encoding="utf-8"))
        found = kept["stages"]
        seconds = [f"{found[stage][0]:.1f}" for stage in shown]
        memory = [found["ingest"][1], max(most for _, most in found.values())]
        rows.append([*map(str, asdict(size).values()), *seconds, *(f"{mb:.0f}" for mb in memory)])
        rows[-1] += [f"{ms:.1f}" for ms in kept["serving"]]
    text = PAGE.format(joint=JOINT, factors=OF_FACTORS, codes=CODES, day=datetime.now(UTC)) + table(head, rows) + "\n"
    pages.write("growth", text)


if __name__ == "__main__":
    main()
