"""From a folder of meshes to a parametrised collection: what the stages up to `factors` find, in files of a run.

A collection that is a product by design has no need of it.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np

from geometry.calculus import ShellSpace
from geometry.coarsening import coarsen
from geometry.energy import Material
from geometry.mean import elastic_mean
from geometry.mesh import TriangleMesh
from geometry.nric import WeightedNorm
from geometry.prolongation import Prolongation
from training import figure
from training.config import Config, ConfigError
from training.factors import between, group, names, overlap
from training.files import write_json, write_npz
from training.ingest import MeshCollection, normalised, read_collection
from training.modes import localisation, pga, spga
from training.shell_collection import ShellCollection
from training.tangents import tangents


def material(config: Config) -> Material:
    """Of the shell, as the configuration says."""
    settings = config.material
    return Material(settings.mu, settings.lambda_, settings.eta)


def _meshes(config: Config) -> MeshCollection:
    if config.collection.generator == "figure":
        labels, vertices, faces = figure.poses()
        return MeshCollection(tuple(labels), vertices, faces)
    if config.collection.data is None:
        raise ConfigError("collection.data: say where the meshes are, here or with --data")
    return read_collection(config.collection.data)


def ingest(folder: Path, config: Config) -> dict[str, Any]:
    """``reference.npz``, and in ``shapes.npz`` names and normalised vertices (n, V, 3), coarsened where asked for."""
    settings = config.collection
    meshes = _meshes(config)
    chosen = meshes.index(settings.reference)
    vertices, scale = normalised(meshes, chosen)
    fine = TriangleMesh.from_arrays(vertices[chosen], meshes.faces)
    facts: dict[str, Any] = {"shapes": len(vertices), "vertices": vertices.shape[1], "reference": meshes.names[chosen]}
    facts["notes"] = list(meshes.notes)
    reference, more = fine, {}
    if 0 < settings.coarse_vertices < vertices.shape[1]:
        coarsening = coarsen(fine, settings.coarse_vertices, vertices)
        exact, vertices = vertices, vertices[:, coarsening.fine_index]
        reference = TriangleMesh.from_arrays(vertices[chosen], coarsening.faces)
        more = {"fine_vertices": fine.vertices, "fine_faces": fine.faces, "fine_index": coarsening.fine_index}
        errors = Prolongation.of(reference, fine).errors(vertices, exact)
        facts |= {"coarse_vertices": vertices.shape[1], "prolongation": errors}
    if meshes.file_vertices is not None and len(meshes.file_vertices) > len(fine.vertices):
        more["file_vertices"] = meshes.file_vertices
    write_reference(folder, reference, scale, **more)
    write_npz(folder / "shapes.npz", names=np.array(meshes.names), vertices=vertices)
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


def mean(folder: Path, config: Config) -> dict[str, Any]:
    """``mean.npz``: the elastic mean of all shapes, where the tangent space is attached."""
    found = elastic_mean(ShellSpace(_reference(folder), material(config)), _shapes(folder))
    facts = {"status": str(found.status), "iterations": found.iterations, "residual": found.residual}
    write_npz(folder / "mean.npz", vertices=found.vertices, **{k: np.array(v) for k, v in facts.items()})
    return facts | {"reason": found.reason}


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
