"""From a folder of meshes to a parametrised collection: what the stages up to `factors` find, in files of a run.

A collection that is a product by design has no need of it.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.coarsening import coarsen
from shapespace.mesh.prolongation import Prolongation
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.shell.energy import Material
from shapespace.shell.mean import Mean, elastic_mean
from shapespace.shell.space import ShellSpace
from shapespace.solve.status import Status
from shapespace.training.collection import figure
from shapespace.training.collection.ingest import MeshCollection, normalised, read_collection
from shapespace.training.runs.config import Config, ConfigError
from shapespace.training.runs.files import write_json, write_npz
from shapespace.training.runs.progress import waiting
from shapespace.training.space.factors import between, group, names, overlap
from shapespace.training.space.modes import localisation, pga, spga
from shapespace.training.space.shell_collection import ShellCollection
from shapespace.training.space.tangents import tangents


def material(config: Config) -> Material:
    """Of the shell, as the configuration says."""
    settings = config.material
    return Material(settings.mu, settings.lambda_, settings.eta)


def _meshes(config: Config) -> MeshCollection:
    if config.collection.generator == "figure":
        labels, vertices, faces = figure.poses()
        return MeshCollection(tuple(labels), vertices, faces)  # the first is the one at rest
    if config.collection.data is None:
        raise ConfigError("collection.data: say where the meshes are, here or with --data")
    return read_collection(config.collection.data)


def ingest(folder: Path, config: Config, accepted: Sequence[str] = ()) -> dict[str, Any]:
    """``reference.npz``, and in ``shapes.npz`` names and normalised vertices (n, V, 3), coarsened where asked for.

    Args:
        folder: of the run.
        config: of the run.
        accepted: names or files of shapes that are taken though they are in another unit or order.

    Raises:
        IngestError: the collection can't be used, or shapes of it have to be accepted first.
    """
    settings = config.collection
    meshes = _meshes(config)
    meshes.require_accepted(accepted)
    chosen = meshes.index(settings.reference)
    vertices, scale = normalised(meshes, chosen)
    fine = TriangleMesh.from_arrays(vertices[chosen], meshes.faces)
    facts: dict[str, Any] = {"shapes": len(vertices), "vertices": vertices.shape[1], "reference": meshes.names[chosen]}
    facts["notes"] = list(meshes.notes)
    facts["warnings"] = [warned.sentence for warned in meshes.warnings]
    reference, more = fine, {}
    if 0 < settings.coarse_vertices < vertices.shape[1]:
        with waiting("coarse mesh"):
            coarsening = coarsen(fine, settings.coarse_vertices, vertices)
        exact, vertices = vertices, vertices[:, coarsening.fine_index]
        reference = TriangleMesh.from_arrays(vertices[chosen], coarsening.faces)
        more = {"fine_vertices": fine.vertices, "fine_faces": fine.faces, "fine_index": coarsening.fine_index}
        errors = Prolongation.of(reference, fine).errors(vertices, exact)
        facts |= {
            "coarse_vertices": vertices.shape[1],
            "asked_vertices": settings.coarse_vertices,
            "smallest_angle": float(np.degrees(coarsening.smallest_angle)),
            "smallest_area": coarsening.smallest_area,
            "specks": coarsening.specks,
            "folds": coarsening.folds,
            "reason": coarsening.reason,
            "prolongation": errors,
        }
    if meshes.file_vertices is not None and len(meshes.file_vertices) > len(fine.vertices):
        more["file_vertices"] = meshes.file_vertices
    write_reference(folder, reference, scale, **more)
    places = meshes.places or [(name, 0) for name in meshes.names]
    files, first = map(np.array, zip(*places, strict=True))
    write_npz(folder / "shapes.npz", names=np.array(meshes.names), vertices=vertices, files=files, first=first)
    write_json(folder / "ingest.json", facts)
    return facts


def write_reference(folder: Path, mesh: TriangleMesh, scale: float, **fine: np.ndarray) -> None:
    """``reference.npz``."""
    write_npz(
        folder / "reference.npz",
        vertices=mesh.vertices,
        faces=mesh.faces,
        edges=mesh.edges,
        scale=np.array(scale),
        **fine,
    )


def _reference(folder: Path) -> TriangleMesh:
    with np.load(folder / "reference.npz") as file:
        return TriangleMesh.from_mapping(file)


def _shapes(folder: Path) -> np.ndarray:
    with np.load(folder / "shapes.npz") as file:
        return file["vertices"]


def _mean(folder: Path) -> TriangleMesh:
    with np.load(folder / "mean.npz") as file:
        return _reference(folder).with_vertices(file["vertices"])


class MeanError(ValueError):
    """A collection without a mean, with a sentence that says where and what to do."""


def mean(folder: Path, config: Config) -> dict[str, Any]:
    """``mean.npz``: the elastic mean of all shapes, where the tangent space is attached.

    Raises:
        MeanError: it isn't found.
    """
    reference, shapes = _reference(folder), _shapes(folder)
    with waiting("elastic mean"):
        found = elastic_mean(ShellSpace(reference, material(config)), shapes)
    if found.status is not Status.CONVERGED:
        raise MeanError(_where(folder, shapes, found))
    facts = {"status": str(found.status), "iterations": found.iterations, "residual": found.residual}
    # Where the mean stands shapes are served: there where the reference's file has it.
    vertices = align(found.vertices, reference.vertices)
    write_npz(folder / "mean.npz", vertices=vertices, **{k: np.array(v) for k, v in facts.items()})
    return facts


def _where(folder: Path, shapes: np.ndarray, found: Mean) -> str:
    """Which place of which shape keeps a mean from being found, and what to do about it."""
    with np.load(folder / "shapes.npz") as file:
        files, first = file["files"], file["first"]
    if found.worst is None:
        return f"the shapes have no mean: {found.reason}"
    shape, face = found.worst
    reference = _reference(folder)
    vertex = int(reference.faces[face, 0])
    with np.load(folder / "reference.npz") as file:
        position = float(file["scale"]) * shapes[shape, vertex]
        number = int(file["fine_index"][vertex]) if "fine_index" in file else vertex
        if "file_vertices" in file:
            number = int(np.flatnonzero(file["file_vertices"] == number)[0])
    here, there = (face_areas(x, reference.faces)[face] for x in (shapes[shape], found.vertices))
    return (
        f"the shapes have no mean: {found.reason}. Of all faces, one of {files[shape]} at its vertex "
        f"{number + first[shape]} (counted from {first[shape]}), at ({', '.join(f'{x:.6g}' for x in position)}), is "
        "furthest from the others' with "
        f"{here / there if there else np.inf:.1e} of the area in the mean so far. Mend the mesh there, take this shape "
        "out of the folder, or change coarse_vertices in the configuration so that another vertex is kept"
    )


def modes(folder: Path, config: Config) -> dict[str, Any]:
    """``modes.npz`` and ``modes.json``: logarithms of the shapes at the mean, their sparse modes, PGA's beside them."""
    settings, centre, shapes = config.modes, _mean(folder), _shapes(folder)
    space = ShellSpace(centre, material(config))
    norm = WeightedNorm.of(centre, config.material.eta)
    logarithms = tangents(space, centre.vertices, shapes, settings.log_steps)
    count = min(settings.count, len(shapes) - 1)
    dense = sparse = pga(space, centre.vertices, logarithms.fields, count)
    if settings.sparsity:
        sparse = spga(
            space, centre.vertices, logarithms.fields, count, settings.sparsity, max_iterations=settings.max_iterations
        )
    write_npz(
        folder / "modes.npz",
        nric=sparse.nric,
        vertices=sparse.vertices,
        coefficients=sparse.coefficients,
        lower=sparse.lower,
        upper=sparse.upper,
        localisation=localisation(sparse.nric, norm),
        rank=np.arange(len(sparse)),
        pga_nric=dense.nric,
        pga_vertices=dense.vertices,
        pga_localisation=localisation(dense.nric, norm),
    )
    facts = {
        "modes": len(sparse),
        "converged": sparse.converged,
        "explained": sparse.explained,
        "pga_explained": dense.explained,
        "linearised_logarithms": len(logarithms.fallbacks),
        "asked": settings.count,
        "log_steps": settings.log_steps,
        "steps": list(logarithms.steps),
        "via": list(logarithms.via),
    }
    write_json(folder / "modes.json", facts | {"reasons": list(logarithms.reasons), "history": sparse.history})
    return facts


def factors(folder: Path, config: Config) -> dict[str, Any]:
    """``factors.json``: groups of modes with overlapping supports; modes.npz is put in their order.

    So each factor's latents are a range, as bundles want them. ``rank`` keeps the modes' own order, by strength, from
    which the groups are always formed.
    """
    with np.load(folder / "modes.npz") as file:
        found = dict(file)
    centre = _mean(folder)
    norm = WeightedNorm.of(centre, config.material.eta)
    z = found["nric"][np.argsort(found["rank"])]
    shared = overlap(z, norm)
    groups = group(shared, config.factors.count)
    order = [j for members in groups for j in members]
    places = {rank: place for place, rank in enumerate(found["rank"])}
    columns = [places[j] for j in order]
    found["coefficients"] = found["coefficients"][:, columns]
    for name in ("nric", "vertices", "lower", "upper", "localisation", "rank"):
        found[name] = found[name][columns]
    write_npz(folder / "modes.npz", **found)
    starts = np.cumsum([0, *map(len, groups)])
    write_json(
        folder / "factors.json",
        {
            "factors": [list(range(a, b)) for a, b in itertools.pairwise(starts.tolist())],
            "names": names(groups, z, norm, centre),
            "overlap": between(shared, groups).tolist(),
        },
    )
    return {"factors": len(groups), "largest": max(map(len, groups))}


def collection(folder: Path, config: Config) -> ShellCollection:
    """The collection that the stages found."""
    found = json.loads((folder / "factors.json").read_text())
    with np.load(folder / "modes.npz") as modes, np.load(folder / "reference.npz") as reference:
        return ShellCollection(
            reference=_mean(folder),
            modes=modes["vertices"],
            lower=modes["lower"],
            upper=modes["upper"],
            factors=dict(zip(found["names"], found["factors"], strict=True)),
            steps=config.samples.steps,
            material=material(config),
            scale=float(reference["scale"]),
        )


def extras(folder: Path) -> dict[str, np.ndarray]:
    """What a bundle's geometry holds beside its reference: fine mesh at the mean, modes, codes of the shapes, and which
    vertices those of the files became, where they aren't the same.
    """
    if not (folder / "modes.npz").exists():
        return {}
    with np.load(folder / "modes.npz") as file:
        result = {"modes": file["vertices"].astype(np.float32), "training_codes": file["coefficients"]}
    with np.load(folder / "reference.npz") as file:
        if "file_vertices" in file:
            result["file_vertices"] = file["file_vertices"].astype(np.int32)
        if "fine_vertices" in file:
            fine = TriangleMesh.from_arrays(file["fine_vertices"], file["fine_faces"])
            prolong = Prolongation.of(TriangleMesh.from_mapping(file), fine)
            result |= {
                "fine_vertices": prolong(_mean(folder).vertices),
                "fine_faces": fine.faces.astype(np.int32),
                **prolong.arrays(),
            }
    return result
