"""Samples of a parametrised collection, in files that stay whole if a run is killed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Protocol
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.space import FirstStep
from shapespace.training.runs.atomic_files import NpzFile, reading
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.progress import bar
from shapespace.training.runs.workers import run

DONE, FAILED = "done", "failed"
#: A code whose shape can't be computed is multiplied by SHORTER, up to SHORTENINGS times. Faces collapse mostly at
#: codes near the corners of the box, which are farther from 0 than the codes of training shapes.
SHORTER, SHORTENINGS = 0.85, 3
#: Subfolder of the joint samples: the samples at the codes of the collection's own shapes.
KNOWN = "shapes"
#: Subfolder of the joint samples: derivatives at the first training codes, in the same order.
DERIVATIVES = "derivatives"
#: Fewest samples to learn from: each part of the split needs some.
FEWEST = 10


class SamplesError(RuntimeError):
    """Too few samples to learn from, with a sentence that says why."""


@dataclass(frozen=True)
class SampledShapes:
    """Shapes of a collection."""

    vertices: FloatArray  # (n, V, 3); where a shape could not be found, the last finite shape on the way to it
    # (n, 2E) lengths and angles. Angles are defined up to 2π. The collection chooses the value: the nearest to the
    # reference's angle, or the value at the end of a path from the reference.
    nric: FloatArray
    reasons: list[str]  # (n,) why the shape was not found, or an empty string
    # (n, m, 2E) derivatives of ``nric`` by the code, zero where a shape failed; None where they are not computed
    derivatives: FloatArray | None = None


@dataclass(frozen=True)
class FeaturePositions:
    """Places of a collection's features on the surface. A code moves a feature to the edges with the same place."""

    surface: FloatArray  # (E, d) angles that tell edges apart
    # (m, d) multiples of these angles, whose sum is the place for a coordinate, in radians of its period
    multiples: IntArray
    # (E, c) further properties of edges. They are equal for edges that a symmetry of codes and places takes to each
    # other.
    constants: FloatArray

    @property
    def angles(self) -> FloatArray:
        """Place (E, m) of each edge for each coordinate."""
        return self.surface @ self.multiples.T


class Collection(Protocol):
    """A shape manifold that is parametrised by codes, as the stages from `factors` on need it.

    Attributes:
        reference: z̄, of unit area.
        scale: length of one unit of the reference in the user's units.
        factors: latent indices of each factor, by name; consecutive.
        latent_names: (m,) names of the coordinates.
        coordinates: bounds and periods.
        codes: (n, m) codes of the training shapes; none where a generator gives the collection by design.
        symmetries: involutions of the edges, (E,) each. They take shapes of the collection to shapes of the collection
            and the reference to itself. The combiner also learns from the images of the training samples.
        places: places of features that codes move over the surface; None where no feature moves.
        steps: K of the exponentials; None where shapes are not exponentials.
        first_step: first step of the exponentials.
        limit: the same collection near the limit of many steps; None where that would not be more exact.
        differentiated: the same collection, with derivatives of its shapes; None where these are not known.
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
    def symmetries(self) -> Sequence[IntArray]: ...  # noqa: D102
    @property
    def places(self) -> FeaturePositions | None: ...  # noqa: D102
    @property
    def steps(self) -> int | None: ...  # noqa: D102
    @property
    def first_step(self) -> FirstStep: ...  # noqa: D102
    @property
    def limit(self) -> Collection | None: ...  # noqa: D102
    @property
    def differentiated(self) -> Collection | None: ...  # noqa: D102

    def shapes(self, latents: FloatArray) -> SampledShapes:
        """Compute the shapes of codes (n, m). Each shape depends on its own code alone."""
        ...


@dataclass(frozen=True)
class Samples:
    """Finished samples, in the order of their index, without failed ones."""

    # (n,) increasing. Samples of two folders with the same index belong to the same joint code. It is below 0 for codes
    # of the collection's own shapes.
    index: IntArray
    latents: FloatArray  # (n, m) codes of the shapes
    asked: FloatArray  # (n, m) requested codes; farther from 0 than ``latents`` where a requested code had no shape
    nric: NDArray[np.float32]  # (n, 2E) lengths and angles
    vertices: NDArray[np.float32]  # (n, V, 3)

    @property
    def shortened(self) -> NDArray[np.bool_]:
        """Whether each code (n,) was shortened."""
        return (self.latents != self.asked).any(axis=1)


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
    """Compute the shapes of codes (n, m) into ``folder/part-*.npz``, except for parts that exist already.

    Each part is written as soon as it is finished, in any order. It has the status of each sample, done or failed, and
    the reason of a failure. Parts of other codes or of another part size are removed.

    A worker computes one part of ``part_size`` codes at a time, and loses it if it dies. If ``shorten``, a code without
    a shape is shortened until it has one, see SHORTER. The sample has both codes. For scheduler and workers see
    workers.run.

    Yields (done, total, failed) after each part; done includes failed. Raises workers.WorkersError if there are no
    workers. Finished parts stay.
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
    """Compute the arrays of a part, except ``index`` and ``asked``."""
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
    """Return the status (n,) of a part's samples; None where the file is missing, damaged or of other codes."""
    try:
        # Opened here, because np.load leaves a damaged file open.
        with path.open("rb") as file, np.load(file) as part:
            same = np.array_equal(part["index"], index) and np.array_equal(asked_for(part), latents)
            return part["status"] if same else None
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None


def asked_for(part: Mapping[str, NDArray]) -> NDArray:
    """Return the requested codes of a part. Version 0.1 did not shorten codes, and stored them once."""
    return part["asked"] if "asked" in part else part["latents"]


class SamplePart(Mapping[str, NDArray]):
    """The arrays of one part; an array is read when it is used, and raises DamagedFileError if it can't be."""

    def __init__(self, path: Path, arrays: Mapping[str, NDArray]) -> None:
        self._path, self._arrays = path, arrays

    def __getitem__(self, name: str) -> NDArray:
        """Read an array."""
        if name not in self._arrays:
            raise KeyError(name)
        with reading(self._path):
            return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the arrays."""
        return iter(self._arrays)

    def __len__(self) -> int:
        """Return the number of arrays."""
        return len(self._arrays)


def parts(folder: Path) -> Iterator[SamplePart]:
    """Open the files of a folder's samples, one after the other."""
    for path in sorted(folder.glob("part-*.npz")):
        # Opened here, because np.load leaves a damaged file open.
        with path.open("rb") as file:
            with reading(path):
                arrays = np.load(file)
            with arrays:
                yield SamplePart(path, arrays)


def columns(folder: Path, *names: str, done: bool = False) -> dict[str, NDArray]:
    """Read some arrays of the samples of a folder, all or the done ones; an empty mapping where there are no parts."""
    found: dict[str, list[NDArray]] = {name: [] for name in names}
    for part in parts(folder):
        chosen = part["status"] == DONE if done else slice(None)
        for name, arrays in found.items():
            arrays.append((asked_for(part) if name == "asked" else part[name])[chosen])
    return {name: np.concatenate(arrays) for name, arrays in found.items() if arrays}


def indices(folder: Path) -> IntArray:
    """Return the indices of the samples of a folder that have a shape."""
    return columns(folder, "index", done=True)["index"]


def read(folder: Path) -> Samples:
    """Read all samples of a folder, after the samples at the collection's shapes where there are any."""
    names = [field.name for field in fields(Samples)]
    known, joint = (columns(place, *names, done=True) for place in (folder / KNOWN, folder))
    if not known:
        return Samples(**joint)
    known["index"] = known["index"] - len(columns(folder / KNOWN, "index")["index"])
    return Samples(**{name: np.concatenate([known[name], joint[name]]) for name in names})


def used(folder: Path, asked: FloatArray) -> FloatArray:
    """Return the requested codes (n, m), each replaced by its shortened code if it was shortened."""
    found, codes = columns(folder, "index", "latents", done=True), asked.copy()
    codes[found["index"]] = found["latents"]
    return codes


def split(index: IntArray, test: float, validation: float, rng: np.random.Generator) -> dict[str, IntArray]:
    """Split indices at random into sorted parts: a share for the test, and a share of the rest for the validation."""
    order = rng.permutation(index)
    n_test = max(1, round(test * len(order)))
    n_validation = max(1, round(validation * (len(order) - n_test)))
    return {
        "test": np.sort(order[:n_test]),
        "validation": np.sort(order[n_test : n_test + n_validation]),
        "train": np.sort(order[n_test + n_validation :]),
    }
