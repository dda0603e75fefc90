"""Samples of a parametrised collection, in files that a killed run leaves whole."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.atomic_files import NpzFile
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.progress import bar
from shapespace.training.runs.workers import run

DONE, FAILED = "done", "failed"
#: A code whose shape can't be computed is multiplied by SHORTER, up to SHORTENINGS times. Faces collapse mostly at
#: codes near the corners of the box, which lie farther out than the training shapes do.
SHORTER, SHORTENINGS = 0.85, 3
#: Subfolder of the joint samples: the samples at the codes of the collection's own shapes.
KNOWN = "shapes"
#: Subfolder of the joint samples: derivatives at some of the training codes, in the order of these.
DERIVATIVES = "derivatives"
#: Fewest samples to learn from: each part of the split needs some.
FEWEST = 10


class SamplesError(RuntimeError):
    """Samples that nothing can be learned from, with a sentence that says why."""


@dataclass(frozen=True)
class SampledShapes:
    """Shapes of a collection.

    Attributes:
        vertices: (n, V, 3); where a shape could not be found, the last finite one on the way to it.
        nric: (n, 2E) lengths and angles. Angles are defined up to 2π, and the collection says which value is meant: the
            nearest to the reference's, or the one at the end of a path from the reference.
        reasons: for each why it failed, or an empty string.
        derivatives: (n, m, 2E) of ``nric`` by the code, zero where a shape failed; None where they are not computed.
    """

    vertices: FloatArray
    nric: FloatArray
    reasons: list[str]
    derivatives: FloatArray | None = None


@dataclass(frozen=True)
class FeaturePositions:
    """Where the coordinates of a collection are on its surface: a code moves a feature to the edges whose place it is.

    Attributes:
        surface: (E, d) angles that tell edges apart.
        multiples: (m, d) of these, whose sum is the place of a coordinate, in radians of its period.
        constants: (E, c) what else an edge is, the same for all edges that symmetries which move places as they move
            codes take to each other.
    """

    surface: FloatArray
    multiples: IntArray
    constants: FloatArray

    @property
    def angles(self) -> FloatArray:
        """(E, m) the place of each coordinate at each edge."""
        return self.surface @ self.multiples.T


class Collection(Protocol):
    """A shape manifold with a parametrisation by codes: what the stages from `factors` on need to know.

    Attributes:
        reference: z̄, of unit area.
        scale: length of one unit of the reference in the user's units.
        factors: latent indices of each factor, by name; consecutive.
        latent_names: (m,) names of the coordinates.
        coordinates: bounds and periods.
        codes: (n, m) of the shapes that the collection was made from, none where it is by design.
        symmetries: involutions of the edges, (E,) each, that take shapes of the collection to shapes of the collection
            and the reference to itself; the combiner sees each training sample's images too.
        places: where features are that codes move over the surface; None where none move.
        steps: K of the exponentials; None where shapes are not made by steps.
        finer: the same by exponentials of twice as many steps; None where that would not be more exact.
        differentiated: the same, whose shapes come with their derivatives; None where these are not known.
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
    def codes(self) -> FloatArray: ...  # noqa: D102
    @property
    def symmetries(self) -> list[IntArray]: ...  # noqa: D102
    @property
    def places(self) -> FeaturePositions | None: ...  # noqa: D102
    @property
    def steps(self) -> int | None: ...  # noqa: D102
    @property
    def finer(self) -> Collection | None: ...  # noqa: D102
    @property
    def differentiated(self) -> Collection | None: ...  # noqa: D102

    def shapes(self, latents: FloatArray) -> SampledShapes:
        """The shapes of codes (n, m), each depending on nothing but its own code."""
        ...


@dataclass(frozen=True)
class Samples:
    """Finished samples, in the order of their index; failed ones are left out.

    Attributes:
        index: (n,) increasing; samples of two folders with the same index belong to the same joint code. Below 0 for
            codes of the collection's own shapes.
        latents: (n, m) codes that the shapes have.
        asked: (n, m) codes that were asked for; farther from 0 than ``latents`` where they had no shape.
        nric: (n, 2E).
        vertices: (n, V, 3).
    """

    index: IntArray
    latents: FloatArray
    asked: FloatArray
    nric: NDArray[np.float32]
    vertices: NDArray[np.float32]

    @property
    def shortened(self) -> NDArray[np.bool_]:
        """(n,) which codes had to be shortened."""
        found: NDArray[np.bool_] = (self.latents != self.asked).any(axis=1)
        return found


def draw(
    collection: Collection,
    folder: Path,
    latents: FloatArray,
    part_size: int,
    title: str,
    *,
    shorten: bool = False,
    scheduler: str | None = None,
    workers: int = -1,
) -> Iterator[tuple[int, int, int]]:
    """Compute the shapes of codes (n, m) into ``folder/part-*.npz``, leaving out parts that are there already.

    A part is written whole as soon as it is finished, in whatever order, and says of each of its samples whether it is
    done or failed and why.

    Args:
        collection: what to draw from; sent to the workers.
        folder: gets one file for each part, and loses parts of other codes or another part size.
        latents: (n, m).
        part_size: codes in a part: what a worker is given at a time, and what is lost with it.
        title: of the progress bar.
        shorten: whether a code that has no shape is shortened until it has one, see SHORTER; its sample says so.
        scheduler: see workers.run.
        workers: see workers.run.

    Yields:
        (done, total, failed) after each part, the failed ones counted among those done.

    Raises:
        workers.WorkersError: no workers to be had; what is finished stays.
    """
    folder.mkdir(parents=True, exist_ok=True)
    indices = np.split(np.arange(len(latents)), range(part_size, len(latents), part_size))
    parts = {folder / f"part-{k:05d}.npz": index for k, index in enumerate(indices)}
    for path in set(folder.glob("part-*.npz")) - set(parts):
        path.unlink()
    found = {path: _status(path, index, latents[index]) for path, index in parts.items()}
    missing = [path for path, status in found.items() if status is None]
    statuses = [status for status in found.values() if status is not None]
    done, failed = sum(map(len, statuses)), sum(int((status != DONE).sum()) for status in statuses)
    results = run(partial(_part, collection, shorten), [latents[parts[path]] for path in missing], scheduler, workers)
    with bar(title, "sample", len(latents), initial=done) as drawn:
        for k, part in results:
            index = parts[missing[k]]
            NpzFile(missing[k]).write(index=index, asked=latents[index], **part)
            done, failed = done + len(index), failed + int((part["status"] != DONE).sum())
            drawn.update(len(index))
            yield done, len(latents), failed
    if not missing:
        yield done, len(latents), failed


def _part(collection: Collection, shorten: bool, asked: FloatArray) -> dict[str, NDArray]:
    """The arrays of a part, except ``index`` and ``asked``."""
    shapes, latents = collection.shapes(asked), asked.copy()
    vertices, nric, reasons = shapes.vertices.copy(), shapes.nric.copy(), np.array(shapes.reasons, dtype=object)
    for _ in range(SHORTENINGS if shorten else 0):
        left = np.flatnonzero(reasons != "")
        if not len(left):
            break
        shorter = latents[left] * SHORTER
        again = collection.shapes(shorter)
        latents[left] = shorter
        found = np.array(again.reasons) == ""
        vertices[left[found]], nric[left[found]] = again.vertices[found], again.nric[found]
        reasons[left[found]] = ""
    failed = reasons != ""
    latents[failed] = asked[failed]
    slopes = {} if shapes.derivatives is None else {"derivatives": shapes.derivatives.astype(np.float32)}
    return slopes | {
        "latents": latents,
        "nric": nric.astype(np.float32),
        "vertices": vertices.astype(np.float32),
        "status": np.where(failed, FAILED, DONE),
        "reason": reasons.astype(np.str_),
    }


def _status(path: Path, index: IntArray, latents: FloatArray) -> NDArray[np.str_] | None:
    """(n,) DONE or FAILED of a part's samples; None where the file is missing, damaged or of other codes."""
    try:
        # Opened here, because np.load leaves a damaged file open.
        with path.open("rb") as file, np.load(file) as part:
            same = np.array_equal(part["index"], index) and np.array_equal(asked_for(part), latents)
            return part["status"] if same else None
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None


def asked_for(part: Mapping[str, NDArray]) -> NDArray:
    """Codes that the samples of a part were asked for; version 0.1 did not shorten any, and stored only those used."""
    return part["asked"] if "asked" in part else part["latents"]


def parts(folder: Path) -> Iterator[Mapping[str, NDArray]]:
    """The files of a folder's samples, opened one after the other; arrays are read when they are asked for."""
    for path in sorted(folder.glob("part-*.npz")):
        with np.load(path) as part:
            yield part


def columns(folder: Path, *names: str) -> dict[str, NDArray]:
    """Some arrays of all samples of a folder, failed ones included; an empty mapping where there are no parts."""
    found: dict[str, list[NDArray]] = {name: [] for name in names}
    for part in parts(folder):
        for name, arrays in found.items():
            arrays.append(asked_for(part) if name == "asked" else part[name])
    return {name: np.concatenate(arrays) for name, arrays in found.items() if arrays}


def indices(folder: Path) -> IntArray:
    """Indices of the samples of a folder that have a shape."""
    found = columns(folder, "index", "status")
    return found["index"][found["status"] == DONE]


def read(folder: Path) -> Samples:
    """Read all parts of a folder, and before them those of the collection's shapes, where it has some."""
    fields = "index", "latents", "asked", "nric", "vertices"
    found: dict[str, list[NDArray]] = {name: [] for name in fields}
    known = len(columns(folder / KNOWN, "index").get("index", ()))
    for place, first in ((folder / KNOWN, -known), (folder, 0)):
        for part in parts(place):
            done = part["status"] == DONE
            for name in fields:
                found[name].append((asked_for(part) if name == "asked" else part[name])[done])
            found["index"][-1] = found["index"][-1] + first
    return Samples(*(np.concatenate(found[name]) for name in fields))


def used(folder: Path, asked: FloatArray) -> FloatArray:
    """Codes (n, m) as asked for, except those that had to be shortened, which are given as they were used."""
    found, codes = columns(folder, "index", "latents", "status"), asked.copy()
    done = found["status"] == DONE
    codes[found["index"][done]] = found["latents"][done]
    return codes


def split(index: IntArray, test: float, validation: float, rng: np.random.Generator) -> dict[str, IntArray]:
    """Split indices at random into sorted parts: a share of all is test, one of the rest validation, the rest train."""
    order = rng.permutation(index)
    n_test = max(1, round(test * len(order)))
    n_validation = max(1, round(validation * (len(order) - n_test)))
    return {
        "test": np.sort(order[:n_test]),
        "validation": np.sort(order[n_test : n_test + n_validation]),
        "train": np.sort(order[n_test + n_validation :]),
    }
