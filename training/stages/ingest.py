"""Stage `ingest`: read and check the meshes, scale them, coarsen them, and prepare the way back to the fine mesh."""

import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.bundle.attributes import surface_arrays, surface_entry
from shapespace.counted import counted
from shapespace.mesh.attached_parts import attach_part
from shapespace.mesh.coarsening import coarsen
from shapespace.mesh.fine_detail import GAIN, RIDGES
from shapespace.mesh.prolongation import AttachedPart, Prolongation, submesh
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.collection.appearance import kept, reference_surface, texture_bytes
from shapespace.training.collection.groups import groups_of
from shapespace.training.collection.large_arrays import some_vertices, stacked
from shapespace.training.collection.mesh_collection import MeshCollection, normalised
from shapespace.training.collection.mirror import find_mirror, mirrored
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.progress import waiting
from shapespace.training.runs.settings import NEARLY_COARSE, CollectionSettings
from shapespace.training.space.related import FOLDS
from shapespace.training.stages.stage import Run, Stage, StageWarning

#: Most vertices of all fine shapes together for which fine detail is learned. It takes memory for several copies.
MOST_DETAILED = 8_000_000
#: Smallest angle of a good coarse mesh, in degrees.
LEAST_ANGLE = 2
#: What helps against a poor coarse mesh.
REMEDY = "another collection.coarse_vertices may avoid it, or better triangles there in the files"


def ingest(run: Run) -> None:
    """Write ``reference.npz``; of meshes also ``shapes.npz``, ``ingest.json``, their prolongation and their surface.

    ``shapes.npz`` has normalised vertices (n, V, 3), coarsened where the settings ask for it. Raises IngestError if the
    collection can't be used, or shapes of it have to be accepted first.
    """
    directory, settings = run.directory, run.config.collection
    if run.by_design:
        write_reference(directory, run.collection.reference, run.collection.scale)
        return
    meshes = run.meshes
    del run.meshes  # they may be large
    chosen = meshes.index(settings.reference)
    related = {} if settings.related is None else {"group": groups_of(meshes.names, settings.related)}
    vertices, scale = normalised(meshes, chosen)
    fine = TriangleMesh.from_arrays(vertices[chosen], meshes.faces)
    images, original_index, notes = _mirror_images(settings, meshes, vertices, fine.edges)
    facts: dict[str, Any] = {"shapes": len(vertices), "vertices": vertices.shape[1], "reference": meshes.names[chosen]}
    facts["images"] = len(images)
    if related:
        groups = int(related["group"].max()) + 1
        notes.append(f"{counted(groups, 'group')} of related shapes: to measure errors, whole groups are left out")
    facts["notes"] = [*meshes.notes, *notes]
    facts["warnings"] = [warned.sentence for warned in meshes.warnings]
    reference, index, coarsened = _coarse_mesh(settings, meshes, fine, vertices, images)
    facts |= coarsened
    more = {}
    if reference is not fine:
        more = {"fine_vertices": fine.vertices, "fine_faces": fine.faces, "fine_index": index}
        exact, vertices = vertices, vertices[:, index]
        others = np.delete(np.arange(len(exact)), chosen)
        held = others[:: min(FOLDS, len(others))]
        prolongation = _prolong(directory, meshes, reference, fine, vertices, exact, held)
        facts["prolongation"] = prolongation
        facts["notes"] += [
            f"{part['name']} is attached and moves {part['carried']}, with an error of {part['mean']:.2%} of the "
            f"diagonal on average, {part['max']:.2%} at most"
            for part in prolongation.get("parts", ())[1:]
        ]
    if meshes.file_vertices is not None and len(meshes.file_vertices) > len(fine.vertices):
        more["file_vertices"] = meshes.file_vertices
    write_reference(directory, reference, scale, **more)
    places = meshes.places or [(name, 0) for name in meshes.names]
    original = np.concatenate([np.arange(len(vertices)), original_index])
    files, first = (np.array(each)[original] for each in zip(*places, strict=True))
    directory.shapes.write(
        names=np.array([*meshes.names, *(f"{meshes.names[k]} (mirrored)" for k in original_index)]),
        vertices=np.concatenate([vertices, images[:, index]]),
        original=original,
        files=files,
        first=first,
        **related,
    )
    surface, left_out = reference_surface(settings.data, meshes, chosen)
    facts["warnings"] += left_out
    if surface:
        facts["notes"].append(kept(surface))
        directory.surface.write(**surface_arrays(surface), **texture_bytes(surface))
        directory.surface_names.write(surface_entry(surface).model_dump())
    directory.ingest.write(facts)
    directory.log("ingested", **facts)


def write_reference(run: RunDirectory, mesh: TriangleMesh, scale: float, **fine: np.ndarray) -> None:
    """Write ``reference.npz``, see RunDirectory.reference."""
    run.reference.write(vertices=mesh.vertices, faces=mesh.faces, edges=mesh.edges, scale=np.array(scale), **fine)


def _mirror_images(
    settings: CollectionSettings, meshes: MeshCollection, vertices: FloatArray, edges: IntArray
) -> tuple[FloatArray, IntArray, list[str]]:
    """Return mirror images (k, V, 3) to learn from, the indices (k,) of their originals, and notes."""
    found = find_mirror(vertices, edges) if settings.mirror else None
    if found is None:
        return np.empty((0, *vertices.shape[1:])), np.empty(0, dtype=int), []
    images, original_index = mirrored(vertices, found[0])
    note = (
        f"learns from {len(images)} mirror images too, because {meshes.names[found[1]]} is symmetric; "
        "collection.mirror = false leaves them out"
    )
    return images, original_index, [note] if len(images) else []


def _coarse_mesh(
    settings: CollectionSettings, meshes: MeshCollection, fine: TriangleMesh, vertices: FloatArray, images: FloatArray
) -> tuple[TriangleMesh, IntArray, dict[str, Any]]:
    """Return the mesh to compute with, the fine index (V,) of its vertices, and facts about it.

    It is the shell of the fine mesh, coarsened where the settings ask for fewer vertices, or the fine mesh itself.
    """
    own = np.unique(meshes.shell_faces)
    shell = submesh(fine, own) if meshes.parts else fine
    if not 0 < NEARLY_COARSE * settings.coarse_vertices < len(own):
        return shell, own, {}
    with waiting("simplifying the mesh"):
        every = some_vertices(vertices, own)
        if len(images):
            every = stacked(len(vertices) + len(images), (x[own] for x in itertools.chain(vertices, images)))
        coarsening = coarsen(shell, settings.coarse_vertices, every)
    index = own[coarsening.fine_index]
    facts = {
        "coarse_vertices": len(index),
        "asked_vertices": settings.coarse_vertices,
        "smallest_angle": float(np.degrees(coarsening.smallest_angle)),
        "smallest_area": coarsening.smallest_area,
        "specks": coarsening.specks,
        "folds": coarsening.folds,
        "reason": coarsening.reason,
    }
    return TriangleMesh.from_arrays(fine.vertices[index], coarsening.faces), index, facts


class _Way(NamedTuple):
    """A way to learn a prolongation: whether weights are fitted, and the ridge of the detail, None without detail."""

    weights: bool
    ridge: float | None


def _prolong(
    run: RunDirectory,
    meshes: MeshCollection,
    reference: TriangleMesh,
    fine: TriangleMesh,
    coarse: FloatArray,
    exact: FloatArray,
    held: IntArray,
) -> dict[str, Any]:
    """Write ``prolongation.npz``; return its errors between fine shapes (n, Vf, 3) and prolonged ones (n, V, 3).

    The weights are fitted to all shapes if weights fitted without the shapes ``held`` come closer to these. Detail that
    depends on the whole shape is added in the same way, to fitted weights or to the others: where shapes differ little,
    it learns more from the others. The errors are measured on the shapes ``held``. The reference is not among them,
    because the prolongation is exact there.
    """
    own = np.unique(meshes.shell_faces)
    attached = []
    for part in meshes.parts[1:]:
        index = np.setdiff1d(meshes.faces[part.faces], own)
        attached.append(attach_part(reference, fine.vertices[index], index, coarse, some_vertices(exact, index)))
    bound, every = Prolongation.of(reference, fine, attached), np.arange(len(exact))
    known = np.setdiff1d(every, held)

    def detailed(prolong: Prolongation, ridge: float | None, shapes: IntArray) -> Prolongation:
        if ridge is None:
            return prolong
        return prolong.detailed(reference.vertices, coarse, exact, own, shapes, ridge)

    bases = {True: bound.fitted(coarse, exact, own, known), False: bound}
    plain = [_Way(weights, None) for weights in bases]
    small = exact.shape[0] * exact.shape[1] <= MOST_DETAILED
    others = [_Way(weights, ridge) for weights in bases for ridge in RIDGES] if small else []
    trials = {way: detailed(bases[way.weights], way.ridge, known) for way in (*plain, *others)}
    errors = {way: trial.errors(coarse[held], (exact[k] for k in held)) for way, trial in trials.items()}
    way = min(plain, key=lambda each: errors[each]["mean"])
    best = min(errors, key=lambda each: errors[each]["mean"])
    if errors[best]["mean"] <= (1 - GAIN) * errors[way]["mean"]:
        way = best
    facts: dict[str, Any] = errors[way]
    base = bound.fitted(coarse, exact, own, every) if way.weights else bound
    run.prolongation.write(**detailed(base, way.ridge, every).arrays())
    if attached:
        distances = trials[way].distances(coarse[held], (exact[k] for k in held))
        facts["parts"] = _part_errors(meshes, own, attached, distances)
    return facts


def _part_errors(
    meshes: MeshCollection, own: IntArray, attached: list[AttachedPart], distances: Iterable[FloatArray]
) -> list[dict[str, Any]]:
    """Return how each part is carried and its ``mean`` and ``max`` error, from distances (Vf,) for each shape."""
    indices = [own, *(part.vertices for part in attached)]
    found = np.array([[(away[index].mean(), away[index].max()) for index in indices] for away in distances])
    how = ["shell", *("rigidly" if part.rigid else "affinely" for part in attached)]
    return [
        {"name": part.name, "carried": carried, "mean": mean, "max": most}
        for part, carried, mean, most in zip(
            meshes.parts, how, found[..., 0].mean(axis=0).tolist(), found[..., 1].max(axis=0).tolist(), strict=True
        )
    ]


def _warnings(run: RunDirectory) -> list[StageWarning]:
    facts = run.ingest.read_if_written()
    sentences = [*facts.get("notes", ()), *facts.get("warnings", ())]
    if facts.get("reason"):
        sentences.append(f"coarse mesh: {facts['reason']}")
    if facts.get("folds"):
        sentences.append(
            f"coarse mesh: {counted(facts['folds'], 'pair')} of neighbouring faces that are folded onto one another in "
            f"some shape. Logarithms and samples may fail there; {REMEDY}"
        )
    if facts.get("smallest_angle", np.inf) < LEAST_ANGLE:
        sentences.append(
            f"coarse mesh: the smallest angle of a face is {facts['smallest_angle']:.1f}°. Below {LEAST_ANGLE}°, "
            f"shapes are found slowly and less exactly; {REMEDY}"
        )
    return [StageWarning(sentence) for sentence in sentences]


STAGE = Stage(
    name="ingest",
    version=1,
    settings=lambda config: [config.collection],
    run=ingest,
    results=lambda run: [
        run.reference.path,
        run.prolongation.path,
        run.shapes.path,
        run.ingest.path,
        run.surface.path,
        run.surface_names.path,
    ],
    warnings=_warnings,
)
