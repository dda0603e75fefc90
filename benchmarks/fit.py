"""docs/measurements/fit.md: accuracy, uncertainty and cost of fitting scans.

``python -m benchmarks.fit`` measures the bundled models. ``--data FOLDER`` adds each bundle FOLDER/NAME with unseen
shapes in FOLDER/NAME.npz, as ``vertices`` (n, V, 3) in the order of the bundle.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from benchmarks import pages
from benchmarks.pages import ROOT, table
from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.closest_points import MeshProximity, VertexFaces
from shapespace.mesh.rigid_motion import Placement, align
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.model.fit_result import FitStatus, Fitted
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel, load
from shapespace.training.collection.generators import figure

#: Number of points of a scan; noise as a share of the diagonal; share of outliers.
POINTS, NOISE, OUTLIERS = 4000, 0.005, 0.02
#: A fit has failed if its error exceeds this multiple of the error of the code that `encode` finds for the same shape,
#: whose vertices it knows, and this share of the diagonal. NINETY is half the width of a 90 % interval, in standard
#: deviations.
FAILED, FAR, NINETY = 2.0, 0.01, 1.645
VARIANTS = ("whole", "noisy", "camera")
#: Steps of the closest-point fit with principal components; candidates for the weight of the mean; number of training
#: shapes that choose the weight.
COMPONENT_STEPS, HOLDS, CHOOSING = 40, (1e-5, 1e-4, 1e-3, 1e-2, 1e-1), 4
#: Stored figures, one file for each model.
FIGURES = ROOT / "runs" / "fit"
#: Stored times of fits, one row for each kind of scan: `benchmarks.fit_time`.
FIT_TIMES = ROOT / "runs" / "fit-times.json"


@dataclass
class Row:
    """Results for one kind of shapes and one variant of scans."""

    kind: str
    variant: str
    errors: list[float] = field(default_factory=list)
    encoded: list[float] = field(default_factory=list)
    components: list[float] = field(default_factory=list)
    converged: list[bool] = field(default_factory=list)
    shapes: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    held: list[float] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)


def sampled(vertices: FloatArray, faces: IntArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Draw points (count, 3) at random on a surface."""
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(vertices, faces, process=False), count, seed=rng)
    return np.asarray(points)


def remeshed(vertices: FloatArray, faces: IntArray, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Return another mesh of a surface, with one random vertex in each cell of a grid."""
    fine = trimesh.Trimesh(vertices, faces, process=False).subdivide()
    order = rng.permutation(len(fine.vertices))
    cells = np.floor(fine.vertices[order] / (0.015 * diagonal(vertices))).astype(np.int64)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    of_vertex = np.empty(len(order), np.int64)
    of_vertex[order] = cell.ravel()
    corners = of_vertex[fine.faces]
    a, b, c = corners.T
    return fine.vertices[order[first]], corners[(a != b) & (b != c) & (c != a)]


def seen(vertices: FloatArray, faces: IntArray, rng: np.random.Generator) -> FloatArray:
    """Return points (n, 3) that are visible to one camera, far away in a random direction."""
    size = float(diagonal(vertices))
    points = sampled(vertices, faces, 10 * POINTS, rng)
    turned = points @ Rotation.random(random_state=rng).as_matrix().T
    cells = np.floor(turned[:, :2] / (size / 120)).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    front = np.full(cell.max() + 1, -np.inf)
    np.maximum.at(front, cell.ravel(), turned[:, 2])
    points = points[turned[:, 2] > front[cell.ravel()] - 0.02 * size]
    return points[rng.choice(len(points), min(POINTS, len(points)), replace=False)]


def scan(
    vertices: FloatArray, faces: IntArray, variant: str, number: int, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Return a scan of a shape (V, 3), in the same place: points, and faces or none."""
    none, size = np.zeros((0, 3), np.int64), float(diagonal(vertices))
    if variant == "whole":
        if number % 2:
            return remeshed(vertices, faces, rng)
        return sampled(vertices, faces, POINTS, rng), none
    points = seen(vertices, faces, rng) if variant == "camera" else sampled(vertices, faces, POINTS, rng)
    points = points + NOISE * size * rng.standard_normal(points.shape)
    if variant == "noisy":
        strays = rng.choice(len(points), int(OUTLIERS * len(points)), replace=False)
        low, high = points.min(axis=0), points.max(axis=0)
        points[strays] = low + (high - low) * rng.random((len(strays), 3))
    return points, none


def by_components(
    training: FloatArray, count: int, points: FloatArray, start: Placement, hold: float, *, partial: bool
) -> FloatArray:
    """Fit principal components of training shapes (n, V, 3) to points by closest points; return vertices (V, 3).

    This is the iterated fit of Scalismo's tutorial on fitting without correspondence, with a Gaussian of aligned
    vertices.
    """
    mean = training.mean(axis=0)
    _, spread, axes = np.linalg.svd((training - mean).reshape(len(training), -1), full_matrices=False)
    modes = (spread[:count, None] / np.sqrt(len(training)) * axes[:count]).reshape(-1, *mean.shape)
    place, shape, tree, weights = start, mean, cKDTree(points), np.zeros(len(modes))
    for _ in range(COMPONENT_STEPS):
        there = place.back(points)
        away, own = cKDTree(shape).query(there)
        pairs = [(own, there, away)]
        if not partial:
            away, other = tree.query(place(shape))
            pairs.append((np.arange(len(shape)), there[other], away))
        index, goal, far = (np.concatenate([pair[k] for pair in pairs]) for k in range(3))
        near = far <= np.quantile(far, 0.95)
        index, goal = index[near], goal[near]
        A = modes[:, index].reshape(len(modes), -1)
        penalty = hold * np.trace(A @ A.T) / len(modes) * np.eye(len(modes))
        weights = np.linalg.solve(A @ A.T + penalty, A @ (goal - mean[index]).ravel())
        shape = mean + np.tensordot(weights, modes, 1)
        place = Placement.between(shape[index], place(goal))
    return place(shape)


class Bench:
    """Measurements of one model.

    Args:
        model: a model with a name.
        by_surface: whether to measure the distance of the surface, not of vertices.
    """

    def __init__(self, model: ShapeModel, *, by_surface: bool) -> None:
        self.model, self.by_surface = model, by_surface
        self.fans = VertexFaces(model.faces, len(model.vertices))
        # The first fit also prepares what a model needs once.
        model.fit_scan(sampled(model.vertices, model.faces, POINTS, np.random.default_rng(0)))
        times = []
        for code in model.population.sample(12, 1).astype(np.float32):
            began = time.process_time()
            model.shape(code, quality=Quality.FULL)
            times.append(time.process_time() - began)
        self.solved = float(np.median(times))

    @cached_property
    def training(self) -> FloatArray:
        """The training shapes (n, V, 3), as stored in the model."""
        codes = self.model.decoder.training_codes
        if codes is None:
            raise ValueError(f"{self.model.manifest.name} has no codes of the training shapes, as components need")
        return np.stack([self.model.shape(code, quality=Quality.FULL).vertices for code in codes.astype(np.float32)])

    def distance(self, found: FloatArray, truth: FloatArray) -> float:
        """Return the mean distance of shapes (V, 3) in the same place, as a fraction of the diagonal."""
        if self.by_surface:
            away = MeshProximity(found, self.fans).closest(truth).distances
        else:
            away = np.linalg.norm(found - truth, axis=1)
        return float(away.mean() / diagonal(truth))

    def tries(self, kind: str, shapes: FloatArray, truths: FloatArray | None) -> Iterator[Row]:
        """Yield a row for each variant of scans of shapes (n, V, 3), with their codes (n, m) if known."""
        for variant in VARIANTS:
            row = Row(kind, variant)
            for number, shape in enumerate(shapes):
                self.one(row, number, shape, None if truths is None else truths[number])
            yield row

    def one(self, row: Row, number: int, shape: FloatArray, truth: FloatArray | None) -> None:
        """Measure one scan of a shape (V, 3), with its code (m,) if known."""
        rng, model, variant = np.random.default_rng(number), self.model, row.variant
        partial = variant == "camera"
        points, faces = scan(shape, model.faces, variant, number, rng)
        turn, shift = Rotation.random(random_state=rng).as_matrix(), diagonal(shape) * rng.standard_normal(3)
        points, there = points @ turn.T + shift, shape @ turn.T + shift
        began = time.process_time()
        found = model.fit_scan((points, faces), partial=partial)
        row.seconds.append((time.process_time() - began) / self.solved)
        row.errors.append(self.distance(found.placement(found.shape.vertices), there))
        row.converged.append(found.status is FitStatus.CONVERGED)
        row.shapes.append(found.solved + found.rough / 3)
        if truth is None:
            encoded = model.encode(shape)
            row.encoded.append(self.distance(align(encoded.shape.vertices, shape), shape))
            begun = Placement.between(self.training.mean(axis=0), found.placement(found.shape.vertices))
            hold = self.holds[variant]
            fitted = by_components(self.training, model.dimension, points, begun, hold, partial=partial)
            row.components.append(self.distance(fitted, there))
        elif row.converged[-1]:
            self.interval(row, found, truth)

    @cached_property
    def holds(self) -> dict[str, float]:
        """Strength with which components hold on to the mean, for each variant of scans."""
        chosen = {}
        for variant in VARIANTS:
            away: dict[float, list[float]] = {hold: [] for hold in HOLDS}
            for number, k in enumerate(np.linspace(0, len(self.training) - 1, CHOOSING).round().astype(int)):
                shape, others = self.training[k], np.delete(self.training, k, axis=0)
                points, _ = scan(shape, self.model.faces, variant, number, np.random.default_rng(number))
                start = Placement.between(others.mean(axis=0), shape)
                for hold, errors in away.items():
                    count, partial = self.model.dimension, variant == "camera"
                    found = by_components(others, count, points, start, hold, partial=partial)
                    errors.append(self.distance(found, shape))
            chosen[variant] = min(away, key=lambda hold: float(np.median(away[hold])))
        return chosen

    def interval(self, row: Row, found: Fitted, truth: FloatArray) -> None:
        """Record whether intervals contain a code (m,), and their width."""
        deviations = np.sqrt(found.covariance.diagonal())
        off = np.abs(self.model.latents.shorter(found.code - truth))
        row.held.append(float((off <= NINETY * deviations).mean()))
        row.widths.append(float(np.median(deviations / np.sqrt(self.model.population.covariance.diagonal()))))


def middle(values: list[float]) -> str:
    """Return the median of shares in percent, without the sign."""
    return f"{100 * float(np.median(values)):.3f}"


def failures(*rows: Row) -> list[int]:
    """Count tries, failures, failures with a status that says so, and false alarms."""
    counts = np.zeros(4, int)
    for row in rows:
        errors, converged = np.array(row.errors), np.array(row.converged)
        failed = errors > np.maximum(FAILED * np.array(row.encoded or 0), FAR)
        counts += [len(errors), failed.sum(), (failed & ~converged).sum(), (~failed & ~converged).sum()]
    return [int(count) for count in counts]


def held(name: str, rows: list[Row]) -> str:
    """Say which shares of the coordinates are within their intervals, over the models of one variant of scans."""
    shares = sorted(float(np.mean(row.held)) for row in rows if row.held)
    return f"{name} {100 * np.median(shares):.0f} % ({100 * shares[0]:.0f} to {100 * shares[-1]:.0f})"


def kinds(
    model: ShapeModel, unseen: FloatArray | None, count: int
) -> Iterator[tuple[str, FloatArray, FloatArray | None]]:
    """Yield kinds of shapes (n, V, 3), with their codes (n, m), or None where only the shapes are known."""
    if unseen is not None:
        yield "unseen", unseen[: 2 * count], None
    codes = np.clip(model.population.sample(count, 123), model.lower, model.upper)
    yield "drawn", np.stack([model.decode(code) for code in codes]), codes


def measure(name: str, model: ShapeModel, unseen: FloatArray | None, count: int) -> list[Row]:
    """Measure one model on all kinds of shapes."""
    bench = Bench(model, by_surface=name == "freaky-torus")
    every = list(kinds(model, unseen, count))
    if name == "figure":
        shapes = figure.poses(len(figure.NAMED) + count)[1][len(figure.NAMED) :]
        every.append(("training", shapes, np.stack([model.encode(shape).code for shape in shapes])))
    found = []
    for kind, shapes, codes in every:
        for row in bench.tries(kind, shapes, codes):
            print(name, kind, row.variant, middle(row.errors), flush=True)
            found.append(row)
    return found


def write_page() -> None:
    """Write the page from all stored figures."""
    files = {file.stem: pages.read_figures(file) for file in sorted(FIGURES.glob("*.json"))}
    every: dict[tuple[str, str], list[Row]] = {}
    for name, found in files.items():
        for row in (Row(**each) for each in found):
            every.setdefault((name, row.kind), []).append(row)
    unseen = {name: rows for (name, kind), rows in every.items() if kind == "unseen"}
    drawn = {name: rows for (name, kind), rows in every.items() if kind == "drawn"}
    models = {name: [row for (other, _), rows in every.items() if other == name for row in rows] for name in files}
    tried, lost, noticed, _ = failures(*(row for rows in every.values() for row in rows))
    scans = "whole", "noisy", "one camera"
    counts = sorted({len(row.errors) for rows in every.values() for row in rows})
    largest = {
        name: max(np.median(row.errors) / np.median(row.components) for row in rows) for name, rows in unseen.items()
    }
    farther = [f"{name} (up to {100 * (ratio - 1):.1f} % larger)" for name, ratio in largest.items() if ratio > 1]

    def line(name: str, rows: list[Row]) -> list[str]:
        many, wrong, told, _ = failures(*rows)
        errors = [f"{middle(row.errors)} / {middle(row.components)}" for row in rows]
        return [name, *errors, f"{wrong} of {many}" + (f" ({wrong - told})" if wrong > told else "")]

    def listed(some: dict[str, list[Row]], kind: int) -> str:
        found = {name: failures(*rows) for name, rows in some.items()}
        return ", ".join(f"{name} {each[kind]} of {each[0]}" for name, each in found.items() if each[kind])

    page = pages.render(
        "fit",
        points=POINTS,
        noise=NOISE,
        outliers=OUTLIERS,
        failed=FAILED,
        far=FAR,
        choosing=CHOOSING,
        tries=f"{counts[0]} to {counts[-1]} tries of each kind",
        all=tried,
        lost=lost,
        noticed=noticed,
        farther=" and ".join(farther),
        times=[float(np.median(np.concatenate([row.seconds for row in rows]))) for rows in models.values()],
        names=list(models),
        table=table(("", *scans, "wrong"), (line(name, rows) for name, rows in unseen.items())),
        drawn=[max(float(np.median(rows[k].errors)) for rows in drawn.values()) for k in range(3)],
        drawn_wrong=listed(drawn, 1),
        alarms=listed(models, 3),
        timed=pages.read_figures(FIT_TIMES),
        held=", ".join(
            held(scans[k], [rows[k] for name, rows in drawn.items() if name != "freaky-torus"]) for k in range(3)
        ),
        measured=pages.measured_with(*FIGURES.glob("*.json")),
    )
    pages.write("fit", page)


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of other bundles and of shapes that they have not seen")
    parser.add_argument("--count", type=int, default=10, help="shapes of each kind, twice as many unseen ones")
    parser.add_argument("--page", action="store_true", help="measure nothing, and write the page of what is there")
    parser.add_argument("names", nargs="*", help="models to measure; by default all")
    given = parser.parse_args()
    bundles = {name: ROOT / "models" / name for name in ("figure", "freaky-torus")}
    bundles |= {file.stem: given.data / file.stem for file in sorted(given.data.glob("*.npz"))} if given.data else {}
    FIGURES.mkdir(exist_ok=True)
    with threadpool_limits(1):
        for name in [] if given.page else given.names or bundles:
            unseen = None
            if name == "figure":
                # The generator makes unseen poses, after the named poses, which are training shapes.
                known = len(figure.NAMED)
                unseen = figure.poses(known + 2 * given.count, seed=77)[1][known:]
            elif name != "freaky-torus":
                with np.load(given.data / f"{name}.npz", allow_pickle=False) as arrays:
                    unseen = arrays["vertices"]
            found = measure(name, load(bundles[name]), unseen, given.count)
            pages.write_figures(FIGURES / f"{name}.json", [asdict(row) for row in found])
    write_page()


if __name__ == "__main__":
    main()
