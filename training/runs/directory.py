"""The run directory: every file that a run leaves, by name, with its reader and its writer."""

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
    """The files of one run; none need be there.

    n shapes, m modes, V vertices, E edges of the mesh that is computed with.

    Attributes:
        folder: that holds them.
    """

    folder: Path

    def _npz(self, name: str) -> NpzFile:
        return NpzFile(self.folder / f"{name}.npz")

    def _json(self, name: str) -> JsonFile:
        return JsonFile(self.folder / f"{name}.json")

    # What ran.

    @property
    def config(self) -> TextFile:
        """The configuration, with what the command line changed in it."""
        return TextFile(self.folder / "config.toml")

    def is_run(self) -> bool:
        """Whether this is a run directory at all."""
        return self.config.path.is_file()

    def stamp(self, stage: str) -> JsonFile:
        """What is known of a stage that has begun: ``key``, ``basis``, ``version``, and at its end ``seconds``.

        Where it is to do again only ``basis`` and ``version``: its folders of samples are of that basis.
        """
        return self._json(f"stages/{stage}")

    def is_of_0_1(self) -> bool:
        """Whether version 0.1 began it, which logged what it did but gave stages no version."""
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
        """The lines of ``log.jsonl``; one that a kill cut short is left out."""
        for line in self._log.read_text(encoding="utf-8").splitlines() if self._log.exists() else ():
            try:
                yield json.loads(line)
            except json.JSONDecodeError:
                continue

    @property
    def traceback(self) -> TextFile:
        """Of an error that is a fault of this program."""
        return TextFile(self.folder / "traceback.txt")

    # ingest

    @property
    def data(self) -> JsonFile:
        """For each file of the collection, by name, ``bytes``, ``time`` and ``sha256`` when it was read."""
        return self._json("data")

    @property
    def reference(self) -> NpzFile:
        """``vertices (V, 3)``, ``faces``, ``edges``, ``scale``; where the meshes are finer ``fine_vertices``,
        ``fine_faces`` and ``fine_index (V)``; ``file_vertices`` where the files have others.
        """
        return self._npz("reference")

    @property
    def prolongation(self) -> NpzFile:
        """From the mesh that is computed with to the fine one: Prolongation.arrays; where the meshes are finer."""
        return self._npz("prolongation")

    @property
    def shapes(self) -> NpzFile:
        """``names (n)``, ``vertices (n, V, 3)`` normalised, ``files (n)``, ``first (n)`` number of a vertex in each.

        Mirror images come last; ``original (n)`` says which shape each is, or is the image of.
        """
        return self._npz("shapes")

    @property
    def ingest(self) -> JsonFile:
        """Notes and warnings on the collection, and what the coarse mesh is like."""
        return self._json("ingest")

    @property
    def surface(self) -> NpzFile:
        """What the reference's file had beside triangles: bundle.surface.surface_arrays, and ``textures`` as bytes."""
        return self._npz("surface")

    @property
    def surface_names(self) -> JsonFile:
        """The names that belong to it: bundle.schema.SurfaceEntry."""
        return self._json("surface")

    # mean, modes, factors

    @property
    def mean(self) -> NpzFile:
        """``vertices (V, 3)`` of the centred mean; its ``status``, ``iterations``, ``residual``; ``steps``, K."""
        return self._npz("mean")

    @property
    def modes_by_strength(self) -> NpzFile:
        """The sparse modes as they are found, strongest first: ``nric``, ``vertices``, ``coefficients``, ``lower``,
        ``upper``, ``localisation``; and ``pga_nric``, ``pga_vertices``, ``pga_localisation`` of the principal ones.
        """
        return self._npz("modes-by-strength")

    @property
    def decomposition(self) -> JsonFile:
        """How the modes were found: ``modes``, ``explained``, ``history``, and what each logarithm took."""
        return self._json("modes")

    @property
    def modes(self) -> NpzFile:
        """The arrays of `modes_by_strength`, once there are factors in their order; and ``rank (m)``, the place of each
        mode there.
        """
        return self._npz("modes")

    @property
    def factors(self) -> JsonFile:
        """``factors``, lists of modes; ``names``; ``overlap (J, J)``."""
        return self._json("factors")

    # samples: see runs.sampling for what is in these folders.

    @property
    def samples(self) -> Path:
        """Folder of the joint samples; in ``shapes/`` those at the codes of the collection's shapes, in
        ``derivatives/`` those of the first training codes with ``derivatives (n, m, 2E)``.
        """
        return self.folder / "samples"

    def factor_samples(self, j: int) -> Path:
        """Folder of a factor's own samples."""
        return self.samples / f"factor-{j}"

    @property
    def split(self) -> NpzFile:
        """Indices of the joint samples: ``train``, ``validation``, ``test``."""
        return NpzFile(self.samples / "split.npz")

    # networks

    def network(self, name: str) -> Path:
        """The file of a network."""
        return self.folder / "networks" / f"{name}.safetensors"

    def networks(self) -> list[Path]:
        """The files of all networks that are there."""
        return sorted(self.network("*").parent.glob("*.safetensors"))

    @property
    def histories(self) -> JsonFile:
        """``epoch``, ``best`` and losses of each network by the name of its file."""
        return self._json("networks/histories")

    # generalisation

    @property
    def generalisation(self) -> JsonFile:
        """How near spaces come to shapes that they were found without: see stages.generalisation."""
        return self._json("generalisation")

    @property
    def least_general(self) -> NpzFile:
        """Of these shapes the farthest, ``given (V, 3)``, and ``found (V, 3)``, the nearest in its space."""
        return self._npz("least-general")

    # evaluation

    @property
    def exact(self) -> Path:
        """Folder of exact shapes that only the evaluation needs, in folders like those of samples."""
        return self.folder / "exact"

    @property
    def evaluation(self) -> JsonFile:
        """All figures."""
        return self._json("evaluation")

    @property
    def gallery(self) -> NpzFile:
        """Shapes for the report."""
        return self._npz("gallery")

    # export

    @property
    def encoded(self) -> JsonFile:
        """How near the bundle comes to the shapes that it learned from, and which codes lie outside its bounds."""
        return self._json("encoded")

    @property
    def least_near(self) -> NpzFile:
        """Of these shapes the farthest, ``given (V, 3)``, and ``found (V, 3)``, the shape of its code."""
        return self._npz("least-near")

    @property
    def report(self) -> TextFile:
        """The page."""
        return TextFile(self.folder / "report.html")

    def study(self, name: str) -> JsonFile:
        """What a benchmark measured on this run, with the ``key`` of the stage that it measured."""
        return self._json(name)

    # Shapes read from the files above.

    def reference_mesh(self) -> TriangleMesh:
        """The mesh that is computed with, at the reference shape."""
        return TriangleMesh.from_mapping(self.reference.read())

    def own_shapes(self) -> FloatArray:
        """(n, V, 3) the shapes of the collection, without mirror images."""
        shapes = self.shapes.read()
        found: FloatArray = shapes["vertices"][: shapes["original"].max() + 1]
        return found

    def mean_mesh(self) -> TriangleMesh:
        """The mesh that is computed with, at the mean shape."""
        return self.reference_mesh().with_vertices(self.mean.read()["vertices"])

    def log_steps(self) -> int:
        """Time steps K of the logarithms, chosen with the mean."""
        return int(self.mean.read()["steps"])

    def training_codes(self) -> FloatArray:
        """Codes (n, m) of all shapes that the run learns from, mirror images last."""
        modes = self.modes.read()
        return np.concatenate([modes["coefficients"], modes["mirrored_coefficients"]])
