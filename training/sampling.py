"""Samples of a parametrised collection, in files that a killed run leaves whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from geometry.mesh import FloatArray, IntArray, TriangleMesh
from training.coordinates import Coordinates


@dataclass(frozen=True)
class Shapes:
    """Shapes of a collection.

    Attributes:
        vertices: (n, V, 3); where a shape could not be found, the last finite one on the way to it.
        nric: (n, 2E) lengths and angles. Only the collection knows which of an angle's representatives is meant:
            the reference's nearest, or the one that a path from the reference leads to.
        reasons: for each why it failed, or an empty string.
    """

    vertices: FloatArray
    nric: FloatArray
    reasons: list[str]


class Collection(Protocol):
    """A shape manifold with a parametrisation by codes: what the stages from `factors` on need to know.

    Attributes:
        reference: z̄, of unit area.
        scale: length of one unit of the reference in the user's units.
        factors: latent indices of each factor, by name; consecutive.
        latent_names: (m,) names of the coordinates.
        coordinates: bounds and periods.
        symmetries: involutions of the edges, (E,) each, that take shapes of the collection to shapes of the collection
            and the reference to itself; the combiner sees each training sample's images too.
    """

    @property
    def reference(self) -> TriangleMesh: ...  # noqa: D102 - see Attributes
    @property
    def scale(self) -> float: ...  # noqa: D102
    @property
    def factors(self) -> dict[str, list[int]]: ...  # noqa: D102
    @property
    def latent_names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def coordinates(self) -> Coordinates: ...  # noqa: D102
    @property
    def symmetries(self) -> list[IntArray]: ...  # noqa: D102

    def shapes(self, latents: FloatArray) -> Shapes:
        """The shapes of codes (n, m), each depending on nothing but its own code."""
        ...


@dataclass(frozen=True)
class Samples:
    """Finished samples, in the order of their index; failed ones are left out.

    Attributes:
        index: (n,) increasing; samples of two folders belong together where theirs agree.
        latents: (n, m).
        nric: (n, 2E).
        vertices: (n, V, 3).
    """

    index: IntArray
    latents: FloatArray
    nric: NDArray[np.float32]
    vertices: NDArray[np.float32]


def write_npz(path: Path, **arrays: Any) -> None:
    """Write an NPZ file whole or not at all."""
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(file, **arrays)
    os.replace(part, path)


def draw(
    collection: Collection, folder: Path, latents: FloatArray, part_size: int, title: str
) -> Iterator[tuple[int, int]]:
    """Compute the shapes of codes (n, m) into ``folder/part-*.npz``, leaving out parts that are there already.

    Yields:
        (done, total) after each part.
    """
    folder.mkdir(parents=True, exist_ok=True)
    indices = np.arange(len(latents))
    parts = np.split(indices, range(part_size, len(indices), part_size))
    for k, index in enumerate(tqdm(parts, desc=title, unit="part", disable=None, leave=False)):
        path = folder / f"part-{k:05d}.npz"
        if not path.exists():
            shapes = collection.shapes(latents[index])
            write_npz(
                path,
                index=index,
                latents=latents[index],
                nric=shapes.nric.astype(np.float32),
                vertices=shapes.vertices.astype(np.float32),
                status=np.array(["failed" if reason else "done" for reason in shapes.reasons]),
                reason=np.array(shapes.reasons),
            )
        yield int(index[-1]) + 1, len(latents)


def read(folder: Path) -> Samples:
    """Read all parts of a folder."""
    fields = "index", "latents", "nric", "vertices"
    found: dict[str, list[NDArray]] = {name: [] for name in fields}
    for path in sorted(folder.glob("part-*.npz")):
        with np.load(path) as part:
            done = part["status"] == "done"
            for name in fields:
                found[name].append(part[name][done])
    return Samples(*(np.concatenate(found[name]) for name in fields))


def split(index: IntArray, test: float, validation: float, rng: np.random.Generator) -> dict[str, IntArray]:
    """Disjoint sorted parts of the samples' indices: test of all, validation of the rest, and train, what is left."""
    order = rng.permutation(index)
    n_test = max(1, round(test * len(order)))
    n_validation = max(1, round(validation * (len(order) - n_test)))
    return {
        "test": np.sort(order[:n_test]),
        "validation": np.sort(order[n_test : n_test + n_validation]),
        "train": np.sort(order[n_test + n_validation :]),
    }
