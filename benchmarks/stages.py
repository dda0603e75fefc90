"""docs/measurements/growth.md: processor seconds and memory of every training stage, by the size of the collection.

``python -m benchmarks.stages`` runs the real command, stage after stage, on capsules that bend and bulge, with one
size changed at a time. ``--people 50 150`` does the same with as many shapes of the generator `people` instead, which
needs the extra ``people``. Results are kept under ``--out``, so a repeated command continues.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Self

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
from shapespace.training.collection.generators.people import people_meshes
from shapespace.training.stages.run import STAGES

#: Number of joint exponentials and of exponentials of each factor, which determine the time; codes for each median.
JOINT, OF_FACTORS, CODES = 100, 50, 30

#: Stored figures of all sizes.
FIGURES = ROOT / "runs" / "growth.json"
#: Stages in the table.
COLUMNS = ("ingest", "modes")

PAGE = """# How training grows

How much time and memory does training need, and what makes it need more? [Is it for my data?](../is-it-for-me.md) has
the minutes of whole runs.

- **Time**: [`ingest`](../reference/run-directory.md) grows with the files, above 40,000 vertices. The other stages grow
  with the coarse mesh. [Some also grow](#the-number-of-shapes) with the number of shapes.
- **Memory**: with {base.shapes} shapes, the largest process needs less than 1 GB up to 40,000 vertices in a file,
  and less than 3 GB for 500,000.

{table}

Times are [CPU time](../reference/glossary.md#cpu-time), without the time to start.

- The base has {base.shapes} shapes of {base.fine:,} vertices, {base.coarse} coarse vertices and {base.modes} modes.
  Each other row changes one of these.
- `samples` and `networks` also grow with the number of samples: here {joint} joint ones and {factors} of each factor.
  The defaults are 4000 and 1000.
- Meshes of more than 20,000 vertices are first thinned by many collapses at once.

{people}The collections of the first table are capsules that bend and bulge. `python -m benchmarks.stages` trains on
them with one BLAS thread, and writes this page from `runs/growth.json`. {measured}
"""


PEOPLE = """## The number of shapes

These are n shapes of the generator `people`, each body in {poses} poses, with {coarse} coarse vertices and {modes}
modes. Stages below {shown:.0f} s are left out.

{seconds}

- **Time**: {most} shapes take {hours:.1f} hours of one core. No stage grows faster than n^{fastest:.2f} from {least} to
  {most} shapes, or than n^{lately:.2f} from {before} to {most}.
- **Memory**: the largest process takes {memory}.

A [cluster](../how-to/cluster.md) computes the samples. Other stages run on one machine,
because they are short or their steps need all shapes. `python -m benchmarks.stages --people` measures this.

"""


@dataclass(frozen=True)
class Size:
    """Size of a collection and of its model."""

    fine: int = 10_000
    shapes: int = 20
    modes: int = 8
    coarse: int = 500

    def beside(self, base: Self) -> str:
        """Say in words where this size differs from another."""
        words = {"fine": "vertices in a file", "coarse": "coarse vertices"}
        own, others = asdict(self), asdict(base)
        return ", ".join(f"{own[key]:,} {words.get(key, key)}" for key in own if own[key] != others[key])


BASE = Size()
#: Poses of each body where the number of people grows, and the fewest seconds whose growth means anything.
PEOPLE_POSES, SHOWN = 5, 5.0
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
    """Return the configuration of a run. Bodies always have the same time steps, so that only their number changes."""
    return f"""
[collection]
data = "{data}"
coarse_vertices = {size.coarse}
[modes]
count = {size.modes}
{"" if size.fine else "log_steps = 8"}
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


def people(count: int) -> tuple[FloatArray, FloatArray]:
    """Return vertices (n, V, 3) and faces of bodies of people in a few poses."""
    meshes = people_meshes(-(-count // PEOPLE_POSES), PEOPLE_POSES)
    return meshes.vertices[:count].astype(np.float32), np.asarray(meshes.faces, np.int32)


def measure(
    size: Size, folder: Path, shapes: Callable[[], tuple[FloatArray, FloatArray]]
) -> dict[str, tuple[float, float]]:
    """Return for each stage processor seconds, including workers, and MB of the largest process. Stages that an earlier
    call has measured are not measured again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data, file, kept = folder / "data.npz", folder / "config.toml", folder / "stages.json"
    if not data.exists():
        vertices, faces = shapes()
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

    found: dict[str, tuple[float, float]] = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    for stage in STAGES:
        if stage not in found:
            found[stage] = until(stage)
            kept.write_text(json.dumps(found), encoding="utf-8")
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


def write_page() -> None:
    """Write the page from the stored figures."""
    found = pages.read_figures(FIGURES)
    rows = []
    for row in found["rows"]:
        title = Size(**row["size"]).beside(BASE) or "base"
        spent = row["seconds"]
        whole = f"{sum(spent.values()):.0f} s", f"{row['megabytes']['most']:.0f} MB"
        rows.append([title, *whole, *(f"{spent[stage]:.1f} s" for stage in COLUMNS)])
    page = PAGE.format(
        people=people_section(found["people"]) if found.get("people") else "",
        base=BASE,
        joint=JOINT,
        factors=OF_FACTORS,
        measured=pages.measured_with(FIGURES),
        table=table(("", "time", "memory", *(f"time of `{stage}`" for stage in COLUMNS)), rows),
    )
    pages.write("growth", page)


def stage_figures(size: Size, folder: Path) -> dict[str, Any]:
    """Measure the stages with a number of people, and return the figures."""
    found = measure(size, folder, partial(people, size.shapes))
    return {
        "day": f"{datetime.now(UTC):%Y-%m-%d}",
        "size": asdict(size),
        "seconds": {stage: seconds for stage, (seconds, _) in found.items()},
        "megabytes": {"most": max(megabytes for _, megabytes in found.values())},
    }


def people_section(rows: list[dict[str, Any]]) -> str:
    """Return the section about the number of shapes, from the rows of at least two numbers in rising order."""
    last, size, counts = rows[-1], Size(**rows[0]["size"]), [row["size"]["shapes"] for row in rows]
    stages = [stage for stage in STAGES if last["seconds"][stage] > SHOWN]
    lines = [[f"`{stage}`", *(f"{row['seconds'][stage]:.0f} s" for row in rows)] for stage in stages]
    lines.append(["all", *(f"{sum(row['seconds'].values()):.0f} s" for row in rows)])
    lines.append(["measured on", *(row["day"] for row in rows)])

    def fastest(k: int) -> float:
        """Return the largest exponent with which a stage grows from row k to the last row."""
        growth = [last["seconds"][stage] / max(rows[k]["seconds"][stage], 0.1) for stage in stages]
        return float(np.log(max(growth)) / np.log(counts[-1] / counts[k]))

    return PEOPLE.format(
        poses=PEOPLE_POSES,
        coarse=size.coarse,
        modes=size.modes,
        shown=SHOWN,
        seconds=table(("", *(f"{count} shapes" for count in counts)), lines),
        hours=sum(last["seconds"].values()) / 3600,
        least=counts[0],
        before=counts[-2],
        most=counts[-1],
        fastest=fastest(0),
        lately=fastest(-2),
        memory=", ".join(
            f"{row['megabytes']['most']:.0f} MB with {count} shapes" for row, count in zip(rows, counts, strict=True)
        ),
    )


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "stages")
    parser.add_argument("--people", type=int, nargs="+", default=[], help="numbers of shapes of people to measure")
    parser.add_argument("--page", action="store_true", help="measure nothing, and write the page of what is there")
    given = parser.parse_args()
    known = json.loads(FIGURES.read_text(encoding="utf-8")) if FIGURES.exists() else {}
    if given.people:
        measured = {row["size"]["shapes"]: row for row in known.get("people", [])}
        for count in given.people:
            measured[count] = stage_figures(replace(BASE, fine=0, shapes=count), given.out / f"people-{count}")
        known["people"] = [measured[count] for count in sorted(measured)]
        pages.write_figures(FIGURES, known)
        write_page()
        return
    rows: list[dict[str, Any]] = []
    for size in [] if given.page else SIZES:
        name = "-".join(map(str, asdict(size).values()))
        path = given.out / f"{name}.json"
        if not path.exists():
            measured = measure(size, given.out / name, partial(collection, size))
            with threadpool_limits(1):
                path.write_text(
                    json.dumps({"stages": measured, "serving": serving(given.out / name)}), encoding="utf-8"
                )
        found = json.loads(path.read_text(encoding="utf-8"))
        stages = {stage: used for stage, used in found["stages"].items() if stage != "factors"}
        most = max(megabytes for _, megabytes in found["stages"].values())
        rows.append(
            {
                "size": asdict(size),
                "seconds": {stage: seconds for stage, (seconds, _) in stages.items()},
                "megabytes": {"ingest": stages["ingest"][1], "most": most},
                "milliseconds": dict(zip(("shape", "fine mesh"), found["serving"], strict=True)),
            }
        )
    if rows:
        pages.write_figures(FIGURES, known | {"day": f"{datetime.now(UTC):%Y-%m-%d}", "rows": rows})
    write_page()


if __name__ == "__main__":
    main()
