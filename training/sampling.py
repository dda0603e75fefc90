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
from geometry.nric import nric, unwrap
from training.coordinates import Coordinates


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

    def shapes(self, latents: FloatArray) -> tuple[FloatArray, list[str]]:
        """Vertices (n, V, 3) of codes (n, m), and for each why it failed, or an empty string."""
        ...


@dataclass(frozen=True)
class Samples:
    """Finished samples, in the order of their index; failed ones are left out."""

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
    reference = collection.reference
    z_reference = nric(reference.vertices, reference.connectivity)
    indices = np.arange(len(latents))
    parts = np.split(indices, range(part_size, len(indices), part_size))
    for k, index in enumerate(tqdm(parts, desc=title, unit="part", disable=None, leave=False)):
        path = folder / f"part-{k:05d}.npz"
        if not path.exists():
            vertices, reasons = collection.shapes(latents[index])
            z = unwrap(nric(vertices, reference.connectivity), z_reference)
            write_npz(
                path,
                index=index,
                latents=latents[index],
                nric=z.astype(np.float32),
                vertices=vertices.astype(np.float32),
                status=np.array(["failed" if reason else "done" for reason in reasons]),
                reason=np.array(reasons),
            )
        yield int(index[-1]) + 1, len(latents)


def read(folder: Path) -> Samples:
    """Read all parts of a folder."""
    latents, z, vertices = [], [], []
    for path in sorted(folder.glob("part-*.npz")):
        with np.load(path) as part:
            done = part["status"] == "done"
            latents.append(part["latents"][done])
            z.append(part["nric"][done])
            vertices.append(part["vertices"][done])
    return Samples(np.concatenate(latents), np.concatenate(z), np.concatenate(vertices))


def split(count: int, test: float, validation: float, rng: np.random.Generator) -> dict[str, IntArray]:
    """Disjoint sorted indices: the test part of all, the validation part of the rest, and what trains."""
    order = rng.permutation(count)
    n_test = max(1, round(test * count))
    n_validation = max(1, round(validation * (count - n_test)))
    return {
        "test": np.sort(order[:n_test]),
        "validation": np.sort(order[n_test : n_test + n_validation]),
        "train": np.sort(order[n_test + n_validation :]),
    }
