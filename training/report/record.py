"""The files of a run's directory, as the report needs them."""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import cycle
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm
from shapespace.files.limits import in_words
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.atomic_files import DamagedFileError, JsonFile, NpzFile
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.space.modes import edge_magnitudes
from shapespace.training.stages.run import STAGES

Value = TypeVar("Value")
#: Colours of the factors in their order; charts take their colours from here too.
HUES = ("#d1495b", "#2a7fba", "#3a9d5d", "#8e5bb5", "#e08a1e", "#1a9aa0", "#b5651d", "#d45fa0", "#7b9a24", "#5560c9")


class ReportError(ValueError):
    """A folder without a readable run, with the reason in one line."""


@dataclass(frozen=True)
class FactorRecord:
    """A group of modes, and its colour throughout the page."""

    name: str
    hue: str
    modes: list[int]


def require_run(run: RunDirectory) -> None:
    """Raise ReportError unless a folder looks like a run directory."""
    if not run.is_run():
        raise ReportError(
            f"{run.folder} is not a run directory: it has no config.toml; name a folder that run has written, such as "
            "runs/NAME"
        )


def _readable(path: Path, read: Callable[[], Value]) -> Value:
    try:
        return read()
    except OSError as error:
        raise ReportError(f"{path} can't be read: {in_words(error, named=False)}") from error
    except DamagedFileError as error:
        raise ReportError(str(error)) from error
    except ValueError as error:
        raise ReportError(f"{path} can't be read: {str(error).splitlines()[0]}") from error


def _read(file: JsonFile | NpzFile) -> dict[str, Any]:
    return _readable(file.path, file.read_if_written)


class Record:
    """The results that a run has written so far; missing results are empty or None. Raises ReportError if the folder is
    no run directory, or a file in it can't be read.
    """

    def __init__(self, run: RunDirectory) -> None:
        self.run = run
        require_run(run)
        self.text = _readable(run.config.path, run.config.read)
        self.config = _readable(run.config.path, lambda: tomllib.loads(self.text))
        self.reference, self.gallery, self.modes, mean = map(_read, (run.reference, run.gallery, run.modes, run.mean))
        self.decomposition, self.evaluation, self.histories = map(
            _read, (run.decomposition, run.evaluation, run.histories)
        )
        self.generalisation, self.encoded, grouping = map(_read, (run.generalisation, run.encoded, run.factors))
        self.geometry = _read(run.geometry)
        #: Map from codes to shapes.
        self.map: str = self.geometry.get("kind", "exponential")
        #: What the report calls the modes.
        self.mode_kind = "SPGA" if self.map == "exponential" else "mode"
        self.mean: FloatArray | None = mean.get("vertices")
        #: (V, 3) base point of tangent vectors: the mean, or the reference if there is no mean.
        self.base = self.reference.get("vertices") if self.mean is None else self.mean
        groups = grouping.get("factors", [])
        self.factors = [
            FactorRecord(name, hue, group)
            for name, hue, group in zip(grouping.get("names", []), cycle(HUES), groups, strict=False)
        ]
        self.overlap = np.array(grouping.get("overlap", []))
        stamps = {name: _read(run.stamp(name)) for name in STAGES}
        #: Wall time in seconds of each stage that has begun; None if it hasn't ended.
        self.seconds = {name: stamp.get("seconds") for name, stamp in stamps.items() if "key" in stamp}

    @cached_property
    def given_up(self) -> list[tuple[str, str]]:
        """Warnings of the finished stages: pairs of a stage and a sentence."""
        found = []
        for stage in (name for name in STAGES if self.seconds.get(name) is not None):
            warnings = _readable(self.run.folder, partial(STAGES[stage].warnings, self.run))
            found += [(stage, warning.sentence) for warning in warnings]
        return found

    def supports(self, tangents: FloatArray) -> FloatArray:
        """Return the supports (m, V) of tangent vectors (m, 2E): where they change the shape, between 0 and 1.

        The value at a vertex is the root mean square, over its edges, of the terms of the weighted norm. Displacements
        would tell less: a bent knee moves the whole lower leg, but lengths and angles change at the knee (paper, figure
        of SPGA modes).
        """
        mesh = TriangleMesh.from_arrays(self.base, self.reference["faces"])  # type: ignore[arg-type]
        norm = WeightedNorm.of(mesh, self.evaluation.get("eta", 1e-2))
        density = edge_magnitudes(tangents, norm) ** 2
        ends, count = mesh.edges.T.ravel(), len(mesh.vertices)
        degree = np.bincount(ends, minlength=count).clip(1)
        result = np.sqrt([np.bincount(ends, np.tile(row, 2), count) / degree for row in density])
        # Percentile instead of maximum: the largest value may belong to a single sliver.
        return (result / np.percentile(result, 99, axis=1, keepdims=True).clip(1e-300)).clip(0, 1)
