"""Stage `export`: the bundle, and the distance between its shapes and the collection's."""

import hashlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import shapespace
from shapespace.arrays import FloatArray
from shapespace.bundle.attributes import from_entry
from shapespace.bundle.geometry import FineMesh, Geometry
from shapespace.bundle.schema import AttributesEntry
from shapespace.coordinates.nric import nric
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.prolongation import Prolongation
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.model.shape_model import ShapeModel
from shapespace.training.collection.large_arrays import room, stacked
from shapespace.training.collection.mesh_collection import normalised
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.progress import progress, waiting
from shapespace.training.runs.provenance import MADE_BY, made_by
from shapespace.training.runs.workers import run as run_on
from shapespace.training.space.generalisation import PrincipalComponents, summary, vertex_distances
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.stage import Run, Stage, StageWarning, listed, read_meshes

#: Most bytes of fine shapes that are compared with the shapes of their codes.
LARGEST_FINE = 2**29
#: Shapes from which several processes find the codes. Each loads the model, which takes time and memory.
MANY = 200


def export_bundle(run: Run) -> None:
    """Write the bundle; of a collection of meshes also ``encoded.json`` and ``least-near.npz``."""
    figures = run.directory.evaluation.read()
    figures.pop(MADE_BY, None)  # the manifest has its own origin
    folder = write_bundle_of(run, figures)
    run.directory.log("exported", bundle=f"{folder.parent.name}/{folder.name}")
    if not run.by_design:
        encode_collection(run)


def write_bundle_of(run: Run, figures: dict[str, Any]) -> Path:
    """Write the bundle of a run that has samples to the models directory, with its figures; return its folder."""
    from shapespace.training.learning.examples import ExampleCorrectedCombiner
    from shapespace.training.learning.export import export

    directory = run.directory
    digest = hashlib.sha256()
    for path in sorted(directory.samples.rglob("*.npz")):
        digest.update(path.read_bytes())
    learner = learner_of(run)
    geometry = Geometry(reference=run.collection.reference) if run.by_design else _geometry(directory)
    composite = learner.main()
    if run.config.export.examples and not run.by_design:
        shapes = nric(directory.shapes.read()["vertices"], directory.reference_mesh().connectivity)
        combiner = ExampleCorrectedCombiner.of(composite, directory.training_codes(), shapes)
        composite = replace(composite, combiner=combiner)
    with waiting("writing the bundle"):
        return export(
            composite, run.collection, run.config, figures, digest.hexdigest(), run.models, geometry, learner.start()
        )


def _geometry(run: RunDirectory) -> Geometry:
    """Return the mean, the fine mesh there, the modes, the codes of the shapes, and the attributes of the mesh."""
    mean, reference, modes = run.mean_mesh(), run.reference.read(), run.modes.read()
    fine = None
    if run.prolongation.exists():
        prolong = Prolongation.from_arrays(run.prolongation.read())
        fine = FineMesh(TriangleMesh.from_arrays(prolong(mean.vertices), reference["fine_faces"]), prolong)
    return Geometry(
        reference=mean,
        fine=fine,
        # Lines of other coordinates than vertices have no tangent vectors.
        modes=None if run.straight_kind() in ("nric", "differential") else modes["vertices"],
        training_codes=run.training_codes(),
        file_vertices=reference.get("file_vertices"),
        surface=_surface(run),
    )


def _surface(run: RunDirectory) -> MeshAttributes | None:
    if not run.surface_names.exists():
        return None
    entry, arrays = AttributesEntry.model_validate(run.surface_names.read()), run.surface.read()
    return from_entry(entry, arrays, {name: arrays[name].tobytes() for name in entry.textures})


def encode_collection(run: Run) -> None:
    """Write ``encoded.json``: the distance between the collection's shapes and the shapes of their codes.

    Codes are found by ``encode`` as it is served, from the fine mesh as users send it. For comparison there are the
    distances of exponentials on the coarse mesh, without networks and without stored training shapes.
    ``least-near.npz`` has the shape with the largest distance, on the coarse mesh.
    """
    directory = run.directory
    model, names = shapespace.load(run.bundle), directory.shapes.read()["names"]
    reference = directory.reference.read()
    scale, given, mesh = float(reference["scale"]), directory.own_shapes(), directory.reference_mesh()
    fine, index = _fine_shapes(run), np.arange(len(mesh.vertices))
    if fine is not None:
        mesh = TriangleMesh.from_arrays(reference["fine_vertices"], reference["fine_faces"])
        given, index = fine, reference["fine_index"]
    diagonal = mesh.diagonal
    encode = partial(_encoded, model, scale)
    other = _of_components(given, mesh.vertices, model.latents.dimension, diagonal)
    # One shape at a time, as the fine shapes of a large collection fill the memory.
    away, inside = room(other.shape), np.zeros(len(given), dtype=bool)
    results = run_on(encode, list(given), workers=-1 if len(given) >= MANY else 1)
    for k, (vertices, inside[k]) in progress(results, "finding the codes of your shapes", "shape", len(given)):
        away[k] = vertex_distances(vertices, given[k], diagonal)
    worst = int(away.mean(axis=1).argmax())
    least_near, _ = encode(given[worst])
    facts = summary(away) | {
        "mesh": "coarse" if fine is None and "fine_faces" in reference else "fine",
        "components": summary(other),
        "modes": directory.decomposition.read().get("left"),
        "remembered": run.config.export.examples,
        "shapes": len(given),
        "outside": [str(names[k]) for k in np.flatnonzero(~inside)],
        "worst": str(names[worst]),
    }
    directory.least_near.write(given=given[worst][index], found=least_near[index])
    directory.encoded.write({MADE_BY: made_by()} | facts)
    directory.log("encoded", **facts)


def _encoded(model: ShapeModel, scale: float, shape: FloatArray) -> tuple[FloatArray, bool]:
    """Return the shape (V, 3) of the code of a shape (V, 3) of a run, and whether the code is inside the bounds."""
    found = model.encode(scale * shape)
    return found.shape.vertices / scale, found.inside_bounds


def _of_components(shapes: FloatArray, reference: FloatArray, count: int, diagonal: float) -> FloatArray:
    """Return vertex distances (n, V) between shapes (n, V, 3) and the nearest shapes of as many components."""
    linear = PrincipalComponents.of(shapes, reference)
    found = (linear.nearest(each[None], count)[0] for each in shapes)
    return stacked(
        len(shapes), (vertex_distances(near, each, diagonal) for near, each in zip(found, shapes, strict=True))
    )


def _fine_shapes(run: Run) -> FloatArray | None:
    """Read the fine shapes (n, Vf, 3) of the collection again, since a run keeps coarse ones only.

    None if the meshes have no finer vertices, if their files are gone, or if the shapes are too large to be compared.
    """
    directory, source = run.directory, run.config.collection.data
    if not directory.prolongation.exists() or (source and not source.exists()):
        return None
    fine = directory.reference.read()["fine_vertices"]
    if len(directory.own_shapes()) * fine.nbytes > LARGEST_FINE:
        return None
    meshes = read_meshes(run.config)
    return normalised(meshes, meshes.index(run.config.collection.reference))[0]


def _warnings(run: RunDirectory) -> list[StageWarning]:
    facts = run.encoded.read_if_written()
    outside = facts.get("outside", [])
    if not outside:
        return []
    sentence = f"the codes of {len(outside)} of {facts['shapes']} shapes lie outside the bounds: {listed(outside)}"
    return [StageWarning(sentence)]


STAGE = Stage(
    name="export",
    version=1,
    settings=lambda config: [config.export.key],
    run=export_bundle,
    results=lambda run: [run.encoded.path, run.least_near.path],
    warnings=_warnings,
)
