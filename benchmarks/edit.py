"""docs/measurements/editing.md: side effects of an edit. ``python -m benchmarks.edit``.

Pulls a fingertip, an elbow or a knee of the bundled figure to its position on the shape of another code, and measures
what else moves. The two codes differ in one factor, which moves almost only this limb.
"""

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks import pages
from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align
from shapespace.model.latent_space import Codes, Distribution
from shapespace.model.options import PriorKind, Target
from shapespace.model.shape_model import ShapeModel, load
from shapespace.training.collection.generators.mannequin import ARM, ELBOW, HIP, KNEE, LEG, SHOULDER, rest

#: Distance of each pull in metres, the figure's unit; number of pulls.
PULL, PULLS = 0.25, 40
#: A factor belongs to a limb if it moves that limb at least this many times as far as any other.
OWN = 5.0
#: Number of codes where this is measured; number of directions that are tried for one pull.
LOOKED_AT, TRIED = 4, 20

PAGE = """# Finding codes: edit and encode

How exact and how fast are `edit` and `encode`, and what else does an edit move?

## What an edit moves

If you pull a fingertip, an elbow or a knee of the figure (1.7 m tall), the limb follows. The other limbs and the head
move {mean} mm on average, {most} mm in the worst pull.

| `prior_kind` | others move | target is missed by | factors that change | shapes computed |
|---|---|---|---|---|
{rows}

- [**`prior_kind`**](../reference/http.md#edit-move-vertices-to-targets) says how a change is spread over the code.
  `groups` is the default.
- **others move**: in mm, the mean over the vertices of the other limbs and the head, as mean / largest of all pulls.
- **target is missed by**: a share of the pull, as median / largest.
- **factors that change**: by more than 1 % of their bounds, as a mean.
- **shapes computed** by the search, as mean / largest.

There are {count} pulls by {pull} m from random codes. A change of one [factor](../reference/glossary.md#factor) can
reach each target. `python -m benchmarks.edit` measures and writes this page.

## Errors and times

`encode` finds codes almost exactly, and `edit` mostly reaches its targets within 1 %. Both take as long as 10 to 31
full shapes.

| | median error | worst | cases over 1 % | time, in full shapes |
|---|---|---|---|---|
| figure, `encode` | 0.0003 % | 0.0016 % | 0 of 200 | 21.7 |
| figure, `edit` | 0.17 % | 0.57 % | 0 of 40 | 31.0 |
| torus, `encode` | 0.0008 % | 0.0012 % | 1 of 200 | 9.8 |
| torus, `edit` | 0.08 % | 1.15 % | 2 of 40 | 23.7 |

- **`encode`** gets shapes of random codes, turned, moved and rounded. The error is a share of a coordinate's range.
  *Worst* is the median error of the least exact coordinate.
- **`edit`** moves 1 to 10 vertices to their places on the shape of another code. The error is the largest distance from
  a target, as a share of the [diagonal](../reference/glossary.md#diagonal). *Worst* is the largest of all.
- **Targets out of reach** take 44 shapes of the figure and 32 of the torus at the median. One edit took 380.
- **All 4601 vertices** at once take a second.

`python -m benchmarks.codes --count 200` measured this table with version 0.2, on one thread beside other processes.
"""


@dataclass(frozen=True)
class Pull:
    """A vertex and its target."""

    start: Codes  # (m,) code to start from
    before: FloatArray  # (V, 3) shape of the code
    limb: str  # name of the limb
    target: Target  # target of the vertex, at the distance ``PULL``


def limbs() -> dict[str, NDArray[np.bool_]]:
    """Mark the vertices (V,) of each limb, and of the head."""
    found = {}
    for side, sign in (("left", 1), ("right", -1)):
        y = rest().vertices * [sign, 1, 1]
        arm = ((y - SHOULDER) @ ARM > 0.08) & (y[:, 0] > SHOULDER[0]) & (y[:, 1] > 0.7)
        found[f"{side} arm"] = arm
        found[f"{side} leg"] = ((y - HIP) @ LEG > 0.12) & (y[:, 0] > 0) & ~arm
    return found | {"head": rest().vertices[:, 1] > 1.47}


def handles() -> list[tuple[str, int]]:
    """Return pairs of a limb and a vertex that is pulled: fingertips, elbows and knees."""
    found = []
    for side, sign in (("left", 1), ("right", -1)):
        y = rest().vertices * [sign, 1, 1]
        arm = limbs()[f"{side} arm"]
        fingertip = np.flatnonzero(arm)[(y[arm] @ ARM).argmax()]
        elbow, knee = (np.linalg.norm(y - joint, axis=1).argmin() for joint in (ELBOW, KNEE))
        found += [(f"{side} arm", int(fingertip)), (f"{side} arm", int(elbow)), (f"{side} leg", int(knee))]
    return found


def still(shape: FloatArray, before: FloatArray, limb: NDArray[np.bool_]) -> FloatArray:
    """Align a shape (V, 3) by least squares over all vertices outside one limb."""
    return align(shape[~limb], before[~limb], carried=shape)


def own_factors(model: ShapeModel, rng: np.random.Generator) -> dict[str, list[int]]:
    """Return by limb the factors that move almost only this limb."""
    parts, before = limbs(), model.decode((model.lower + model.upper) / 2)
    found: dict[str, list[int]] = {name: [] for name in parts}
    for j, factor in enumerate(model.manifest.factors):
        own = slice(factor.start, factor.stop)
        moved: dict[str, float] = dict.fromkeys(parts, 0.0)
        for _ in range(LOOKED_AT):
            code = (model.lower + model.upper) / 2
            code[own] = rng.uniform(model.lower[own], model.upper[own])
            shape = model.decode(code)
            # The moving limb is unknown, so align without each limb in turn.
            fits = [still(shape, before, limb) for limb in parts.values()]
            away = min((np.linalg.norm(fit - before, axis=1) for fit in fits), key=np.median)
            for name, limb in parts.items():
                moved[name] += away[limb].mean()
        first, second = sorted(moved, key=lambda name: moved[name])[-1:-3:-1]
        if moved[first] > OWN * moved[second]:
            found[first].append(j)
    return found


def pulls(model: ShapeModel, count: int, seed: int) -> list[Pull]:
    """Draw random pulls, equally many of each handle where possible."""
    rng, parts, several = np.random.default_rng(seed), limbs(), handles()
    found: list[Pull] = []
    own = own_factors(model, rng)
    starts = iter(model.latents.sample(8 * count, seed, Distribution.GAUSSIAN))
    while len(found) < count:
        limb, vertex = several[len(found) % len(several)]
        start = next(starts)
        before = model.decode(start)
        for _ in range(TRIED):
            factor = model.manifest.factors[rng.choice(own[limb])]
            target = _place(model, start, before, parts[limb], vertex, slice(factor.start, factor.stop), rng)
            if target is not None:
                found.append(Pull(start, before, limb, Target(vertex, target.tolist())))
                break
    return found


def _place(
    model: ShapeModel,
    start: Codes,
    before: FloatArray,
    limb: NDArray[np.bool_],
    vertex: int,
    own: slice,
    rng: np.random.Generator,
) -> FloatArray | None:
    """Return the position of a vertex after it moved by PULL towards a random value of a factor; None if it can't."""
    goal = rng.uniform(model.lower[own], model.upper[own])

    def place(share: float) -> FloatArray:
        code = start.astype(np.float64)
        code[own] += share * (goal - code[own])
        return still(model.decode(code), before, limb)[vertex]

    low, high = 0.0, 1.0
    if np.linalg.norm(place(high) - before[vertex]) < PULL:
        return None
    for _ in range(12):
        middle = (low + high) / 2
        if np.linalg.norm(place(middle) - before[vertex]) < PULL:
            low = middle
        else:
            high = middle
    return place(high)


def row(model: ShapeModel, some: list[Pull], kind: PriorKind) -> tuple[str, float, float]:
    """Edit by every pull. Return a row, and the mean and the largest motion of the other limbs in mm."""
    others, away, factors, shapes = [], [], [], []
    parts = limbs()
    for pull in some:
        found = model.edit(pull.start, [pull.target], prior_kind=kind)
        now = found.placement(found.shape.vertices)
        rest_of_it = np.logical_or.reduce([limb for name, limb in parts.items() if name != pull.limb])
        others.append(np.linalg.norm(now - pull.before, axis=1)[rest_of_it].mean())
        away.append(found.distances[0] / PULL)
        change = np.abs(model.latents.shorter(found.code.astype(np.float64) - pull.start)) / model.latents.width
        factors.append(sum(change[f.start : f.stop].max() > 0.01 for f in model.manifest.factors))
        shapes.append(found.iterations)
    mean, most = 1e3 * float(np.mean(others)), 1e3 * float(np.max(others))
    cells = [
        f"`{kind}`",
        f"{mean:.1f} / {most:.1f}",
        f"{np.median(away):.2%} / {np.max(away):.2%}",
        f"{np.mean(factors):.1f}",
        f"{np.mean(shapes):.1f} / {np.max(shapes)}",
    ]
    return pages.row(cells), mean, most


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=PULLS, help="pulls")
    given = parser.parse_args()
    model = load(pages.ROOT / "models" / "figure")
    some = pulls(model, given.count, 0)
    rows, means, largest = zip(*(row(model, some, kind) for kind in PriorKind), strict=True)
    page = PAGE.format(
        count=given.count, pull=PULL, rows="\n".join(rows), mean=f"{means[0]:.0f}", most=f"{largest[0]:.0f}"
    )
    pages.write("editing", page)


if __name__ == "__main__":
    main()
