"""What a run has left in its directory, as its report needs it."""

from __future__ import annotations

import json
import tomllib
import zipfile
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.losses import losses
from shapespace.training.space.modes import edge_magnitudes

#: In the pipeline's order.
STAGES = ("ingest", "mean", "modes", "factors", "samples", "networks", "evaluation", "export")
#: Of the factors, in their order; in plots too.
HUES = ("#d1495b", "#2a7fba", "#3a9d5d", "#8e5bb5", "#e08a1e", "#1a9aa0", "#b5651d", "#d45fa0", "#7b9a24", "#5560c9")


class ReportError(ValueError):
    """A folder that no report can be made of, with the reason in one line."""


@dataclass(frozen=True)
class Factor:
    """A group of modes, and the hue that stands for it throughout the page."""

    name: str
    hue: str
    modes: list[int]


class Record:
    """What a run has left so far; what isn't there is empty or None.

    Raises:
        ReportError: the folder is no run directory; or, on reading, a file of it is broken.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if not (folder / "config.toml").is_file():
            raise ReportError(f"{folder} is no run directory: it holds no config.toml")
        self.text = self._read("config.toml", "", lambda path: path.read_text(encoding="utf-8"))
        self.config: dict[str, Any] = self._read("config.toml", {}, lambda path: tomllib.loads(self.text))
        self.reference, self.modes, self.gallery = (
            self._arrays(f"{name}.npz") for name in ("reference", "modes", "gallery")
        )
        self.decomposition, self.evaluation, self.histories = (
            self._json(name) for name in ("modes.json", "evaluation.json", "networks/histories.json")
        )
        self.mean: FloatArray | None = self._arrays("mean.npz").get("vertices")
        #: (V, 3) what tangent vectors start from: the mean, or the reference where there is none.
        self.base = self.reference.get("vertices") if self.mean is None else self.mean
        grouping = self._json("factors.json")
        groups = grouping.get("factors", [])
        self.factors = [
            Factor(name, hue, group)
            for name, hue, group in zip(grouping.get("names", []), cycle(HUES), groups, strict=False)
        ]
        self.overlap = np.array(grouping.get("overlap", []))
        stamps = {path.stem: self._json(f"stages/{path.name}") for path in (folder / "stages").glob("*.json")}
        #: Seconds of the stages that are done, None for one at work.
        self.seconds = {name: stamps[name].get("seconds") for name in STAGES if name in stamps}

    def _read(self, name: str, missing: Any, how: Any) -> Any:
        path = self.folder / name
        try:
            return how(path) if path.exists() else missing
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ReportError(f"{path} can't be read: {str(error).splitlines()[0]}") from error

    def _json(self, name: str) -> dict[str, Any]:
        return self._read(name, {}, lambda path: dict(json.loads(path.read_text(encoding="utf-8"))))

    def _arrays(self, name: str) -> dict[str, NDArray]:
        return self._read(name, {}, lambda path: dict(np.load(path)))

    @cached_property
    def given_up(self) -> list[tuple[str, str]]:
        """Stage and sentence of all that the stages which are done gave up."""
        found = []
        for stage in (name for name in STAGES if self.seconds.get(name) is not None):
            lost = self._read("", [], lambda folder, stage=stage: losses(folder, stage))
            found += [(stage, loss.sentence) for loss in lost]
        return found

    @cached_property
    def at_work(self) -> str:
        """What the log says last of a stage that isn't done."""
        path = self.folder / "log.jsonl"
        for line in reversed(path.read_text(encoding="utf-8").splitlines() if path.exists() else []):
            try:
                event = json.loads(line)
            except json.JSONDecodeError:
                continue  # the last line of a run that was killed
            if event.get("event") == "progress":
                return f"{event['what']}: {event['done']} of {event['total']}"
            return ""
        return ""

    def supports(self, tangents: FloatArray) -> FloatArray:
        """Where tangent vectors (m, 2E) act: (m, V) between 0 and 1.

        The root of the mean of the weighted norm's terms over the edges at a vertex. Displacements would tell less: a
        bent knee moves the whole lower leg, but lengths and angles change at the knee (paper, figure of SPGA modes).
        """
        mesh = TriangleMesh.from_arrays(self.base, self.reference["faces"])  # type: ignore[arg-type]
        norm = WeightedNorm.of(mesh, self.evaluation.get("eta", 1e-2))
        density = edge_magnitudes(tangents, norm) ** 2
        ends, count = mesh.edges.T.ravel(), len(mesh.vertices)
        degree = np.bincount(ends, minlength=count).clip(1)
        result = np.sqrt([np.bincount(ends, np.tile(row, 2), count) / degree for row in density])
        # The very largest value may sit on a single sliver.
        return (result / np.percentile(result, 99, axis=1, keepdims=True).clip(1e-300)).clip(0, 1)
