"""The shapes of a collection as tangent vectors at their mean: the discrete logarithms."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm, unwrap
from shapespace.shell.exponential import velocity_of
from shapespace.shell.geodesic import geodesic, halved, towards
from shapespace.shell.space import DiscretePath, ShellSpace
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.outcome import Status
from shapespace.training.runs.progress import progress
from shapespace.training.runs.workers import run
from shapespace.training.space.modes import ModeError

#: Tolerance of the geodesics to the shapes, as a length. It is far below the remainder after all modes.
LOGARITHM_TOLERANCE = 1e-6
#: Number of logarithms that a process computes at a time.
CHUNK = 4
#: Number of neighbours whose geodesics are tried as initial values.
NEIGHBOURS = 4
#: Shapes that are tried from their neighbours at a time, the nearest first. If less than this share is found, the
#: search ends: on faces whose eyelids and lips close it would fail for half of the shapes, and take an hour.
AT_A_TIME, HOPEFUL = 16, 1 / 8


@dataclass(frozen=True)
class Logarithms:
    """Discrete logarithms of the shapes of a collection at their mean."""

    fields: FloatArray  # (n, V, 3) vertex fields, without rigid motion
    # (n,) status of the last geodesic tried. If it is not CONVERGED, the field is the linearised logarithm.
    status: tuple[Status, ...]
    steps: tuple[int, ...]  # (n,) K of the geodesic found, 0 where none was found
    via: tuple[int, ...]  # (n,) neighbour whose geodesic was the initial value, −1 where none was needed
    reasons: tuple[str, ...]  # (n,) why the geodesic was not found from the straight line, or an empty string

    @property
    def fallbacks(self) -> list[int]:
        """Indices of shapes whose logarithm had to be linearised."""
        return [i for i, steps in enumerate(self.steps) if steps == 0]


def logarithms(space: ShellSpace, mean: FloatArray, shapes: ArrayLike, steps: int, workers: int = -1) -> Logarithms:
    """Compute the discrete logarithms of shapes at their mean.

    Initial values of the geodesics are tried in this order:

    1. the straight line of lengths and angles. On the way to a far shape it may lead through lengths and angles that no
       surface has;
    2. the geodesic to a neighbour. So the geodesics grow outwards as a minimum spanning tree does;
    3. bisection;
    4. the geodesic to a neighbour, with twice as many steps, because a face may collapse within one long step.

    If all fail, the difference of lengths and angles is projected to the tangent space, with the angles unwrapped from
    the mean's. This is the logarithm to first order. If the second attempt fails for nearly all of many shapes, the
    search ends.

    A logarithm is the inverse of the exponential with the same number of steps K. With the paper's first step,
    logarithms of 4 and of 8 steps differ by 10 to 35 % of their length on real collections.

    Shapes (n, V, 3) may be in any position; the mean is (V, 3). The result does not depend on the number of workers.
    Raises ModeError if a coordinate of a shape is not finite, and WorkersError if processes are killed repeatedly.
    """
    x = np.stack([space.shape(shape) for shape in np.asarray(shapes, dtype=np.float64)])
    bad = np.flatnonzero(~np.isfinite(x).all(axis=(1, 2)))
    if len(bad):
        raise ModeError(f"shape {bad[0]} has a coordinate that is not finite")
    search = _Search(space, mean, x, steps, workers)
    search.directly(bisect=False)
    if search.by_neighbours():
        if search.directly(bisect=True):
            search.by_neighbours()
        search.from_neighbours([(i, j) for i in search.left for j in search.nearest(i)], finer=True)
    return search.result()


#: The shapes of a geodesic and its velocity, or None; its status; the reason why it was not found.
_Found = tuple[tuple[FloatArray, FloatArray] | None, Status, str]


class _Search:
    """Search for geodesics from the mean to shapes, the near ones first."""

    def __init__(self, space: ShellSpace, mean: FloatArray, shapes: FloatArray, steps: int, workers: int) -> None:
        self._space, self._mean, self._shapes, self._steps, self._workers = space, mean, shapes, steps, workers
        self._paths: dict[int, FloatArray] = {}
        self._velocities: dict[int, FloatArray] = {}
        self._via = [-1] * len(shapes)
        self._status, self._reasons = [Status.STALLED] * len(shapes), [""] * len(shapes)
        z = unwrap(space.nric(shapes), space.nric(mean))
        weights = np.sqrt(WeightedNorm.of(space.reference.with_vertices(mean), space.material.eta).squared)
        scaled = z * weights
        squares = (scaled**2).sum(axis=1)
        self._distances: FloatArray = np.add.outer(squares, squares) - 2 * scaled @ scaled.T

    @property
    def left(self) -> list[int]:
        """Shapes without a geodesic."""
        return [i for i in range(len(self._shapes)) if i not in self._paths]

    def _do(self, function: Callable[..., _Found], items: list[tuple[int, tuple]], chunk: int = 1) -> bool:
        """Try a function on some shapes, each with further arguments. Return whether one more geodesic is found."""
        parts = [items[k : k + chunk] for k in range(0, len(items), chunk)]
        work = [[(self._shapes[i], *more) for i, more in part] for part in parts]
        news = False
        results = run(partial(_each, function, self._space, self._mean), work, workers=self._workers)
        unit = f"{chunk} shapes" if chunk > 1 else "shape"
        for k, found in progress(results, "finding paths from the mean to your shapes", unit, len(parts)):
            for (i, _), (connected, status, reason) in zip(parts[k], found, strict=True):
                self._status[i], self._reasons[i] = status, self._reasons[i] or reason
                if connected is not None:
                    (self._paths[i], self._velocities[i]), news = connected, True
        return news

    def directly(self, *, bisect: bool) -> bool:
        """Search from the straight line to each shape, or by bisection. Return whether one more geodesic is found."""
        return self._do(_direct, [(i, (self._steps, bisect)) for i in self.left], 1 if bisect else CHUNK)

    def by_neighbours(self) -> bool:
        """Search from the nearest neighbour that has a geodesic and was not tried, until no such neighbour is left.

        Return False if the search ended before, because it fails for nearly all of many shapes.
        """
        tried: dict[int, set[int]] = {i: set() for i in self.left}
        before, first = len(self._paths), True
        while pairs := [(i, j) for i in self.left if len(tried[i]) < NEIGHBOURS for j in self.nearest(i, tried[i])]:
            pairs.sort(key=lambda pair: float(self._distances[pair]))
            for k in range(0, len(pairs), AT_A_TIME):
                if first and len(self._paths) - before < HOPEFUL * k:
                    return False
                some = pairs[k : k + AT_A_TIME]
                for i, j in some:
                    tried[i].add(j)
                self.from_neighbours(some, finer=False)
            first = False
        return True

    def nearest(self, i: int, without: Collection[int] = ()) -> list[int]:
        """Return the nearest shape that has a geodesic, if there is one."""
        others = [j for j in self._paths if j not in without]
        return [min(others, key=lambda j: (float(self._distances[i, j]), j))] if others else []

    def from_neighbours(self, pairs: list[tuple[int, int]], *, finer: bool) -> None:
        """Search for the geodesic to the first shape of each pair from the geodesic to the second."""
        self._do(_from_neighbour, [(i, (self._paths[j], finer)) for i, j in pairs])
        for i, j in pairs:
            if i in self._paths:
                self._via[i] = j

    def result(self) -> Logarithms:
        """Return the logarithms of all shapes, linearised where there is no geodesic."""
        fields, steps = [], []
        z = self._space.nric(self._mean)
        for i, shape in enumerate(self._shapes):
            path = self._paths.get(i)
            steps.append(0 if path is None else len(path) - 1)
            if path is None:
                fields.append(self._space.project(self._mean, unwrap(self._space.nric(shape), z) - z))
            else:
                fields.append(self._velocities[i])
        return Logarithms(np.stack(fields), tuple(self._status), tuple(steps), tuple(self._via), tuple(self._reasons))


def _each(function: Callable[..., _Found], space: ShellSpace, mean: FloatArray, items: list[tuple]) -> list[_Found]:
    return [function(space, mean, *item) for item in items]


def _direct(space: ShellSpace, mean: FloatArray, shape: FloatArray, steps: int, bisect: bool) -> _Found:
    return _found(geodesic(space, mean, shape, steps, tolerance=LOGARITHM_TOLERANCE, bisect=bisect))


def _from_neighbour(space: ShellSpace, mean: FloatArray, shape: FloatArray, path: FloatArray, finer: bool) -> _Found:
    """Search for the geodesic that begins like the geodesic to a neighbour, or like that with twice as many steps."""
    near = DiscretePath(vertices=path, space=space, status=Status.CONVERGED)
    try:
        first = towards(space, halved(space, near) if finer else near, shape)
    except NotPositiveDefiniteError as error:
        return None, Status.DEGENERATE, f"a shape on the way is degenerate: {error}"
    return _found(geodesic(space, mean, shape, len(first) - 1, tolerance=LOGARITHM_TOLERANCE, first=first))


def _found(path: DiscretePath) -> _Found:
    if not path.converged:
        return None, path.status, path.reason
    velocity = velocity_of(path, LOGARITHM_TOLERANCE)
    if velocity is None:
        return None, Status.STALLED, "no velocity leads to the first shape of the geodesic"
    return (path.vertices, velocity), path.status, ""
