"""The run directory: the name, reader and writer of every file of a run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.atomic_files import JsonFile, NpzFile, TextFile


@dataclass(frozen=True)
class RunDirectory:
    """The files of one run; each may be missing.

    There are n shapes and m modes. The coarse mesh, on which a run computes, has V vertices and E edges.

    Attributes:
        folder: the run directory.
    """

    folder: Path

    def _npz(self, name: str) -> NpzFile:
        return NpzFile(self.folder / f"{name}.npz")

    def _json(self, name: str) -> JsonFile:
        return JsonFile(self.folder / f"{name}.json")

    # The whole run.

    @property
    def config(self) -> TextFile:
        """The configuration, with the changes of the command line."""
        return TextFile(self.folder / "config.toml")

    def is_run(self) -> bool:
        """Return whether the folder is a run directory."""
        return self.config.path.is_file()

    def stamp(self, stage: str) -> JsonFile:
        """``key``, ``basis`` and ``version`` of a stage that has begun, and ``seconds`` once it is done.

        A stage that has to be done again keeps ``basis`` and ``version`` only, which its folders of samples have.
        """
        return self._json(f"stages/{stage}")

    def is_of_0_1(self) -> bool:
        """Return whether version 0.1 began the run: it has a log, but no stage has a version."""
        stamps = (JsonFile(path).read() for path in self.folder.glob("stages/*.json"))
        return self._log.exists() and not any("version" in stamp for stamp in stamps)

    @property
    def _log(self) -> Path:
        return self.folder / "log.jsonl"

    def log(self, event: str, **facts: Any) -> None:
        """Append one line to ``log.jsonl``."""
        line = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **facts}
        with self._log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield the lines of ``log.jsonl``, without a line that a kill cut short."""
        for line in self._log.read_text(encoding="utf-8").splitlines() if self._log.exists() else ():
            try:
                yield json.loads(line)
            except json.JSONDecodeError:
                continue

    @property
    def traceback(self) -> TextFile:
        """Traceback of an error that is a defect of this program."""
        return TextFile(self.folder / "traceback.txt")

    # ingest

    @property
    def data(self) -> JsonFile:
        """``bytes``, ``time`` and ``sha256`` of each file of the collection when it was read, by its name."""
        return self._json("data")

    @property
    def reference(self) -> NpzFile:
        """``vertices (V, 3)``, ``faces``, ``edges``, ``scale``.

        Where the meshes are finer, also ``fine_vertices``, ``fine_faces`` and ``fine_index (V)``. Where the files have
        more vertices, also ``file_vertices``.
        """
        return self._npz("reference")

    @property
    def prolongation(self) -> NpzFile:
        """Prolongation from the coarse mesh to the fine mesh, where the meshes are finer; see Prolongation.arrays."""
        return self._npz("prolongation")

    @property
    def shapes(self) -> NpzFile:
        """``names (n)``, normalised ``vertices (n, V, 3)``, ``files (n)``, ``first (n)`` vertex number of each file.

        Mirror images come last. ``original (n)`` is the index of the original, or of the shape itself.
        """
        return self._npz("shapes")

    @property
    def ingest(self) -> JsonFile:
        """Notes and warnings on the collection, and facts about the coarse mesh."""
        return self._json("ingest")

    @property
    def surface(self) -> NpzFile:
        """Attributes of the reference's file: bundle.attributes.surface_arrays, and textures as bytes."""
        return self._npz("surface")

    @property
    def surface_names(self) -> JsonFile:
        """Names of these attributes: bundle.schema.AttributesEntry."""
        return self._json("surface")

    # mean, modes, factors

    @property
    def mean(self) -> NpzFile:
        """``vertices (V, 3)`` of the centred mean, its ``status``, ``iterations`` and ``residual``; ``steps``, K."""
        return self._npz("mean")

    @property
    def modes_by_strength(self) -> NpzFile:
        """The sparse modes, strongest first: ``nric``, ``vertices``, ``coefficients``, ``lower``, ``upper`` and
        ``localisation``; ``pga_nric``, ``pga_vertices`` and ``pga_localisation`` are for the principal modes.
        """
        return self._npz("modes-by-strength")

    @property
    def decomposition(self) -> JsonFile:
        """Facts about the modes: ``modes``, ``explained``, ``history``, and ``steps`` and ``via`` of each logarithm."""
        return self._json("modes")

    @property
    def modes(self) -> NpzFile:
        """The arrays of `modes_by_strength`, in the order of the factors once there are any.

        ``rank (m)`` is the position of each mode in `modes_by_strength`.
        """
        return self._npz("modes")

    @property
    def factors(self) -> JsonFile:
        """``factors``, lists of modes; ``names``; ``overlap (J, J)``."""
        return self._json("factors")

    # samples: runs.sampling describes the contents of these folders.

    @property
    def samples(self) -> Path:
        """Folder of the joint samples.

        ``shapes/`` has samples at the codes of the collection's shapes. ``derivatives/`` has samples at the first
        training codes, with ``derivatives (n, m, 2E)``.
        """
        return self.folder / "samples"

    def factor_samples(self, j: int) -> Path:
        """Return the folder of a factor's own samples."""
        return self.samples / f"factor-{j}"

    @property
    def split(self) -> NpzFile:
        """Indices of the joint samples: ``train``, ``validation``, ``test``."""
        return NpzFile(self.samples / "split.npz")

    # networks

    def network(self, name: str) -> Path:
        """Return the file of a network."""
        return self.folder / "networks" / f"{name}.safetensors"

    def networks(self) -> list[Path]:
        """Return the files of all networks."""
        return sorted(self.network("*").parent.glob("*.safetensors"))

    @property
    def histories(self) -> JsonFile:
        """``epoch``, ``best`` and losses of each network, by the name of its file."""
        return self._json("networks/histories")

    # generalisation

    @property
    def generalisation(self) -> JsonFile:
        """Distances between held-out shapes and the space without them: see stages.generalisation."""
        return self._json("generalisation")

    @property
    def least_general(self) -> NpzFile:
        """The held-out shape ``given (V, 3)`` with the largest distance, and ``found (V, 3)``, its approximation."""
        return self._npz("least-general")

    # evaluation

    @property
    def exact(self) -> Path:
        """Folder of exact shapes that only the evaluation needs, in folders like the folders of samples."""
        return self.folder / "exact"

    @property
    def evaluation(self) -> JsonFile:
        """All figures of the evaluation."""
        return self._json("evaluation")

    @property
    def gallery(self) -> NpzFile:
        """Shapes for the report."""
        return self._npz("gallery")

    # export

    @property
    def encoded(self) -> JsonFile:
        """Distances between the training shapes and the shapes of their codes; names of shapes outside the bounds."""
        return self._json("encoded")

    @property
    def least_near(self) -> NpzFile:
        """The training shape ``given (V, 3)`` with the largest distance, and ``found (V, 3)``, its code's shape."""
        return self._npz("least-near")

    @property
    def report(self) -> TextFile:
        """The report page."""
        return TextFile(self.folder / "report.html")

    def study(self, name: str) -> JsonFile:
        """Return the file of a benchmark on this run, which has the ``key`` of the measured stage."""
        return self._json(name)

    # Values read from the files above.

    def reference_mesh(self) -> TriangleMesh:
        """Read the coarse mesh at the reference shape."""
        return TriangleMesh.from_mapping(self.reference.read())

    def own_shapes(self) -> FloatArray:
        """Read the shapes (n, V, 3) of the collection, without mirror images."""
        shapes = self.shapes.read()
        found: FloatArray = shapes["vertices"][: shapes["original"].max() + 1]
        return found

    def mean_mesh(self) -> TriangleMesh:
        """Read the coarse mesh at the mean shape."""
        return self.reference_mesh().with_vertices(self.mean.read()["vertices"])

    def log_steps(self) -> int:
        """Read the time steps K of the logarithms, which were chosen with the mean."""
        return int(self.mean.read()["steps"])

    def training_codes(self) -> FloatArray:
        """Read the codes (n, m) of all training shapes, mirror images last."""
        modes = self.modes.read()
        return np.concatenate([modes["coefficients"], modes["mirrored_coefficients"]])
