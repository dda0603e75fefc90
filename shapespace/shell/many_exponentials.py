"""Many exponentials at once, in processes that each keep their symbolic analysis."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.shell.exponential import exponential
from shapespace.shell.space import DiscretePath, ShellSpace


def exponentials(
    space: ShellSpace,
    start: FloatArray,
    velocities: FloatArray,
    steps: int = 16,
    *,
    workers: int = -1,
    chunk: int = 8,
) -> Iterator[DiscretePath]:
    """Shoot from one shape with many velocities, yielding paths in their order as they are finished.

    Processes, not threads: NumPy on small arrays holds the interpreter lock, and a factor belongs to one
    thread. Each sample depends on nothing but its velocity, and each process has one BLAS thread, so results
    are the same whatever ``workers`` and ``chunk`` are. A sample that fails is a path with a status, and stops nothing.

    Args:
        space: where; each process gets a copy.
        start: X_0 (V, 3).
        velocities: (n, V, 3) vertex fields.
        steps: K.
        workers: processes, by default one a core; 1 computes here.
        chunk: velocities sent to a process at a time, to share its analysis among them.
    """
    from joblib import Parallel, delayed

    velocities = np.asarray(velocities, dtype=np.float64)
    parts = [velocities[i : i + chunk] for i in range(0, len(velocities), chunk)]
    if workers == 1:
        finished = (_shoot(space, start, part, steps) for part in parts)
    else:
        parallel = Parallel(n_jobs=workers, return_as="generator", inner_max_num_threads=1, backend="loky")
        finished = parallel(delayed(_shoot)(space, start, part, steps) for part in parts)
    for paths in finished:
        for path in paths:
            yield DiscretePath(**path, space=space)


def _shoot(space: ShellSpace, start: FloatArray, velocities: FloatArray, steps: int) -> list[dict[str, Any]]:
    """Paths without their space: sent with it, each would carry the mesh home."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        paths = [exponential(space, start, v, steps) for v in velocities]
    return [{f.name: getattr(p, f.name) for f in fields(p) if f.name != "space"} for p in paths]
