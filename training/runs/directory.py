"""The run directory: the name, reader and writer of every file of a run."""

from __future__ import annotations

import json
import os
import platform
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.mesh.prolongation import nearest_counts
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.atomic_files import JsonFile, NpzFile, TextFile

File = TypeVar("File")


class NotARunError(ValueError):
    """A folder that holds something else than a run."""


class RunInUseError(RuntimeError):
    """A run that another process is working on."""


class RunFile(Generic[File]):
    """A file or folder of each run directory, by its path there."""

    def __init__(self, kind: Callable[[Path], File], path: str) -> None:
        self.kind, self.path = kind, path

    def __get__(self, run: RunDirectory, _: type[RunDirectory]) -> File:
        return self.kind(run.folder / self.path)


@dataclass(frozen=True)
class RunDirectory:
    """The files of one run; each may be missing.

    There are n shapes and m modes. The coarse mesh, on which a run computes, has V vertices and E edges.
    """

    folder: Path

    # The whole run.

    config = RunFile(TextFile, "config.toml")
    """The configuration, with the changes of the command line."""
    traceback = RunFile(TextFile, "traceback.txt")
    """Traceback of an error that is a defect of this program."""
    _log = RunFile(Path, "log.jsonl")

    def is_run(self) -> bool:
        """Return whether the folder looks like a run directory, so that it can be read."""
        return self.config.path.is_file()

    def was_begun(self) -> bool:
        """Return whether a run wrote the folder, so that it may be written to."""
        return self.is_run() and (self._log.is_file() or self._stamps.is_dir())

    @property
    def _stamps(self) -> Path:
        return self.folder / "stages"

    def begin(self) -> None:
        """Make the folder a run directory, with what says so before anything else. Raises NotARunError if it holds
        something, and no run began it. Nothing is written or removed.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise NotARunError(
                f"{self.folder} is no folder, and a run's results lie in one: name an empty or a new folder with --out"
            )
        # A run that was killed at its begin has left the folder of stamps and no whole configuration.
        own = {"stages", f".{self.config.path.name}.part"}
        if self.folder.exists() and not self.was_begun() and {path.name for path in self.folder.iterdir()} - own:
            raise NotARunError(
                f"{self.folder} holds other files and is not a run directory, so nothing was written there; name an "
                "empty or a new folder with --out"
            )
        self._stamps.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from working on the run; raise RunInUseError if one does.

        The lock belongs to the operating system, which releases it however the process ends.
        """
        import filelock

        lock, file = filelock.FileLock(self._stamps / "lock", timeout=0), TextFile(self._stamps / "process.txt")
        try:
            held = lock.acquire()
        except filelock.Timeout:
            holder = file.read() if file.exists() else "another process"
            raise RunInUseError(
                f"{holder} is working on the run {self.folder}: wait until it ends, or stop it"
            ) from None
        with held:
            file.write(f"process {os.getpid()} on {platform.node()}")
            try:
                yield
            finally:
                file.path.unlink(missing_ok=True)

    def stamp(self, stage: str) -> JsonFile:
        """``key``, ``basis`` and ``version`` of a stage that has begun, and ``seconds`` once it is done.

        A stage that has to be done again keeps ``basis`` and ``version`` only, which its folders of samples have.
        """
        return JsonFile(self._stamps / f"{stage}.json")

    def is_of_0_1(self) -> bool:
        """Return whether version 0.1 began the run: it has a log, but no stage has a version."""
        stamps = (JsonFile(path).read() for path in self.folder.glob("stages/*.json"))
        return self._log.exists() and not any("version" in stamp for stamp in stamps)

    def log(self, event: str, **facts: Any) -> None:
        """Append one line to ``log.jsonl``."""
        line = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **facts}
        with self._log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield the lines of ``log.jsonl``, without lines that are damaged, or that a kill cut short."""
        for line in self._log.read_bytes().splitlines() if self._log.exists() else ():
            with suppress(ValueError, RecursionError):
                event = json.loads(line)
                if isinstance(event, dict):
                    yield event

    def spent(self, stage: str, key: str) -> float:
        """Return the seconds that earlier calls worked on a stage with this key without ending it.

        A call that was killed counts up to its last line in the log.
        """
        total, begun, last = 0.0, None, None
        for event in self.events():
            try:
                now = datetime.fromisoformat(event["time"])
            except (KeyError, TypeError, ValueError):
                continue
            if event.get("event") in ("begin", "end"):
                if begun and last and event["event"] == "begin":
                    total += (last - begun).total_seconds()
                of_it = event.get("stage") == stage
                begun = now if event["event"] == "begin" and of_it and event.get("key") == key else None
                if event["event"] == "end" and of_it:
                    total = 0.0
            last = now
        return total + ((last - begun).total_seconds() if begun and last else 0.0)

    def at_work(self) -> str:
        """Return the progress of the running stage, from the last line of the log; empty if it reports none."""
        last = deque(self.events(), maxlen=1)
        if last and last[0].get("event") == "progress":
            what, done, total = (last[0].get(fact) for fact in ("what", "done", "total"))
            return f"{what}: {done} of {total}"
        return ""

    # ingest

    data = RunFile(JsonFile, "data.json")
    """``bytes``, ``time`` and ``sha256`` of each file of the collection when it was read, by its name."""
    reference = RunFile(NpzFile, "reference.npz")
    """``vertices (V, 3)``, ``faces``, ``edges``, ``scale``; where the meshes are finer, also ``fine_vertices``,
    ``fine_faces`` and ``fine_index (V)``; where the files have more vertices, also ``file_vertices``."""
    prolongation = RunFile(NpzFile, "prolongation.npz")
    """Prolongation from the coarse mesh to the fine mesh, where the meshes are finer; see Prolongation.arrays."""
    shapes = RunFile(NpzFile, "shapes.npz")
    """``names (n)``, normalised ``vertices (n, V, 3)``, ``files (n)``, ``first (n)`` vertex number of each file.
    Mirror images come last. ``original (n)`` is the index of the original, or of the shape itself. With
    ``collection.related``, ``group (originals)`` says which originals are related."""
    ingest = RunFile(JsonFile, "ingest.json")
    """Notes and warnings on the collection, and facts about the coarse mesh."""
    surface = RunFile(NpzFile, "surface.npz")
    """Attributes of the reference's file: bundle.attributes.surface_arrays, and textures as bytes."""
    surface_names = RunFile(JsonFile, "surface.json")
    """Names of these attributes: bundle.schema.AttributesEntry."""

    # mean, modes, factors

    mean = RunFile(NpzFile, "mean.npz")
    """``vertices (V, 3)`` of the centred mean, its ``status``, ``iterations`` and ``residual``; ``steps``, K."""
    geometry = RunFile(JsonFile, "geometry.json")
    """The map from codes to shapes, ``kind``, and what it was chosen by: see space.geometry.GeometryChoice."""
    modes_by_strength = RunFile(NpzFile, "modes-by-strength.npz")
    """The sparse modes, strongest first: ``nric``, ``vertices``, ``coefficients``, ``lower``, ``upper`` and
    ``localisation``; ``pga_nric``, ``pga_vertices`` and ``pga_localisation`` are for the principal modes."""
    decomposition = RunFile(JsonFile, "modes.json")
    """Facts about the modes: ``modes``, ``explained``, ``history``, ``exponential_steps`` K, and ``steps`` and ``via``
    of each logarithm."""
    modes = RunFile(NpzFile, "modes.npz")
    """The arrays of `modes_by_strength`, in the order of the factors once there are any. ``rank (m)`` is the position
    of each mode in `modes_by_strength`."""
    factors = RunFile(JsonFile, "factors.json")
    """``factors``, lists of modes; ``names``; ``overlap (J, J)``."""

    # samples: runs.sampling describes the contents of these folders.

    samples = RunFile(Path, "samples")
    """Folder of the joint samples. ``shapes/`` has samples at the codes of the collection's shapes, ``derivatives/``
    samples at the first training codes, with ``derivatives (n, m, 2E)``."""
    split = RunFile(NpzFile, "samples/split.npz")
    """Indices of the joint samples: ``train``, ``validation``, ``test``."""

    def factor_samples(self, j: int) -> Path:
        """Return the folder of a factor's own samples."""
        return self.samples / f"factor-{j}"

    # networks

    histories = RunFile(JsonFile, "networks/histories.json")
    """``epoch``, ``best`` and losses of each network, by the name of its file."""

    def network(self, name: str) -> Path:
        """Return the file of a network."""
        return self.folder / "networks" / f"{name}.safetensors"

    def networks(self) -> list[Path]:
        """Return the files of all networks."""
        return sorted(self.network("*").parent.glob("*.safetensors"))

    # generalisation

    generalisation = RunFile(JsonFile, "generalisation.json")
    """Distances between held-out shapes and the space without them: see stages.generalisation."""
    least_general = RunFile(NpzFile, "least-general.npz")
    """The held-out shape ``given (V, 3)`` with the largest distance, and ``found (V, 3)``, its approximation."""

    # evaluation

    exact = RunFile(Path, "exact")
    """Folder of exact shapes that only the evaluation needs, in folders like the folders of samples."""
    evaluation = RunFile(JsonFile, "evaluation.json")
    """All figures of the evaluation."""
    gallery = RunFile(NpzFile, "gallery.npz")
    """Shapes for the report."""
    report = RunFile(TextFile, "report.html")
    """The report page."""

    # export

    encoded = RunFile(JsonFile, "encoded.json")
    """Distances between the training shapes and the shapes of their codes; names of shapes outside the bounds."""
    least_near = RunFile(NpzFile, "least-near.npz")
    """The training shape ``given (V, 3)`` with the largest distance, and ``found (V, 3)``, its code's shape."""

    def study(self, name: str) -> JsonFile:
        """Return the file of a benchmark on this run, which has the ``key`` of the measured stage."""
        return JsonFile(self.folder / f"{name}.json")

    # Values read from the files above.

    def reference_mesh(self) -> TriangleMesh:
        """Read the coarse mesh at the reference shape."""
        return TriangleMesh.from_mapping(self.reference.read())

    def own_shapes(self) -> FloatArray:
        """Read the shapes (n, V, 3) of the collection, without mirror images."""
        shapes = self.shapes.read()
        return shapes["vertices"][: shapes["original"].max() + 1]

    def vertex_counts(self) -> FloatArray:
        """Read how many vertices (V,) of the fine mesh are nearest to each vertex of the coarse mesh; 1 without one."""
        reference = self.reference.read()
        if "fine_vertices" not in reference:
            return np.ones(len(reference["vertices"]))
        return nearest_counts(reference["fine_vertices"], reference["fine_index"])

    def mean_mesh(self) -> TriangleMesh:
        """Read the coarse mesh at the mean shape."""
        return self.reference_mesh().with_vertices(self.mean.read()["vertices"])

    def log_steps(self) -> int:
        """Read the time steps K of the logarithms, which were chosen with the mean."""
        return int(self.mean.read()["steps"])

    def straight_kind(self) -> Literal["vertices", "nric", "differential"] | None:
        """Read the kind of straight lines from codes to shapes; None for exponentials."""
        kind = self.geometry.read_if_written().get("kind", "exponential")
        return None if kind == "exponential" else kind

    def steps(self) -> int:
        """Read the time steps K of exponentials: chosen with the modes, or by version 0.2 with the mean."""
        return int(self.decomposition.read().get("exponential_steps", self.log_steps()))

    def training_codes(self) -> FloatArray:
        """Read the codes (n, m) of all training shapes, mirror images last."""
        modes = self.modes.read()
        return np.concatenate([modes["coefficients"], modes["mirrored_coefficients"]])
