"""The stages `ingest`, `mean`, `modes` and `factors` of a collection of meshes, and what they leave for the later ones.

A collection that is a product by design does not need them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import shapespace
from shapespace.arrays import FloatArray, IntArray
from shapespace.bundle.attributes import from_entry, surface_arrays, surface_entry
from shapespace.bundle.geometry import FineMesh, Geometry
from shapespace.bundle.schema import AttributesEntry
from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.mesh.attached_parts import attach_part
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.coarsening import coarsen
from shapespace.mesh.prolongation import Prolongation, submesh
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.shell.energy import Material
from shapespace.shell.mean import Mean
from shapespace.shell.space import ShellSpace
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.outcome import Status
from shapespace.training.collection.appearance import kept, reference_surface, texture_bytes
from shapespace.training.collection.generators import MESHES
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.large_arrays import some_vertices, stacked
from shapespace.training.collection.mesh_collection import MeshCollection, normalised
from shapespace.training.collection.mirror import find_mirror, mirrored
from shapespace.training.runs.config import CollectionSettings, Config, ConfigError
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.progress import progress, waiting
from shapespace.training.runs.sampling import DONE, parts
from shapespace.training.space.codes import box_of, nearest_codes
from shapespace.training.space.factors import between, group, names, overlap
from shapespace.training.space.generalisation import (
    FOLDS,
    LIGHT_STEPS,
    RANDOM,
    PrincipalComponents,
    held_out,
    joined,
    some_folds,
    summary,
    time_steps,
    to_nearest,
    vertex_distances,
)
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.mean import centred_mean
from shapespace.training.space.modes import ModeError, find_modes, localisation, mode_count, pga
from shapespace.training.space.shell_collection import ShellCollection


def material(config: Config) -> Material:
    """Of the shell, as the configuration says."""
    settings = config.material
    return Material(settings.mu, settings.lambda_, settings.eta)


def read_meshes(config: Config) -> MeshCollection:
    """The collection that a run is of; raises ConfigError where none is named, IngestError where it can't be used."""
    settings = config.collection
    if settings.generator is not None:
        return MESHES[settings.generator]()
    if settings.data is None:
        raise ConfigError("collection.data: say where the meshes are, here or with --data")
    return read_collection(settings.data, settings.parts)


def ingest(run: RunDirectory, config: Config, accepted: Sequence[str] = ()) -> dict[str, Any]:
    """``reference.npz``, and in ``shapes.npz`` names and normalised vertices (n, V, 3), coarsened where asked for.

    Args:
        run: gets the files.
        config: of the run.
        accepted: names or files of shapes that are taken though they are in another unit or order.

    Raises:
        IngestError: the collection can't be used, or shapes of it have to be accepted first.
    """
    settings = config.collection
    meshes = read_meshes(config)
    meshes.require_accepted(accepted)
    chosen = meshes.index(settings.reference)
    vertices, scale = normalised(meshes, chosen)
    fine = TriangleMesh.from_arrays(vertices[chosen], meshes.faces)
    own = np.unique(meshes.shell_faces)
    shell = submesh(fine, own) if meshes.parts else fine
    images, original_index, notes = _images(settings, meshes, vertices, fine.edges)
    facts: dict[str, Any] = {"shapes": len(vertices), "vertices": vertices.shape[1], "reference": meshes.names[chosen]}
    facts["images"] = len(images)
    facts["notes"] = [*meshes.notes, *notes]
    facts["warnings"] = [warned.sentence for warned in meshes.warnings]
    reference, more, index = shell, {}, own
    if 0 < settings.coarse_vertices < len(own):
        with waiting("coarse mesh"):
            every = some_vertices(vertices, own)
            if len(images):
                every = stacked(len(vertices) + len(images), (x[own] for x in itertools.chain(vertices, images)))
            coarsening = coarsen(shell, settings.coarse_vertices, every)
        index = own[coarsening.fine_index]
        reference = TriangleMesh.from_arrays(fine.vertices[index], coarsening.faces)
        facts |= {
            "coarse_vertices": len(index),
            "asked_vertices": settings.coarse_vertices,
            "smallest_angle": float(np.degrees(coarsening.smallest_angle)),
            "smallest_area": coarsening.smallest_area,
            "specks": coarsening.specks,
            "folds": coarsening.folds,
            "reason": coarsening.reason,
        }
    if reference is not fine:
        more = {"fine_vertices": fine.vertices, "fine_faces": fine.faces, "fine_index": index}
        exact, vertices = vertices, vertices[:, index]
        others = np.delete(np.arange(len(exact)), chosen)
        held = others[:: min(FOLDS, len(others))]
        facts |= (carried := _prolong(run, meshes, reference, fine, vertices, exact, held))
        facts["notes"] += [
            f"{part['name']} is carried {part['carried']}: {part['mean']:.2%} of the diagonal away on average, "
            f"{part['max']:.2%} at most"
            for part in carried["prolongation"].get("parts", ())[1:]
        ]
    if meshes.file_vertices is not None and len(meshes.file_vertices) > len(fine.vertices):
        more["file_vertices"] = meshes.file_vertices
    write_reference(run, reference, scale, **more)
    places = meshes.places or [(name, 0) for name in meshes.names]
    original = np.concatenate([np.arange(len(vertices)), original_index])
    files, first = (np.array(each)[original] for each in zip(*places, strict=True))
    run.shapes.write(
        names=np.array([*meshes.names, *(f"{meshes.names[k]} (mirrored)" for k in original_index)]),
        vertices=np.concatenate([vertices, images[:, index]]),
        original=original,
        files=files,
        first=first,
    )
    surface, left_out = reference_surface(settings.data, meshes, chosen)
    facts["warnings"] += left_out
    if surface:
        facts["notes"].append(kept(surface))
        run.surface.write(**surface_arrays(surface), **texture_bytes(surface))
        run.surface_names.write(surface_entry(surface).model_dump())
    run.ingest.write(facts)
    return facts


def _images(
    settings: CollectionSettings, meshes: MeshCollection, vertices: FloatArray, edges: IntArray
) -> tuple[FloatArray, IntArray, list[str]]:
    """Mirror images (k, V, 3) to learn from, of which shapes (k,), and what to say of them."""
    found = find_mirror(vertices, edges) if settings.mirror else None
    if found is None:
        return np.empty((0, *vertices.shape[1:])), np.empty(0, dtype=int), []
    images, original_index = mirrored(vertices, found[0])
    note = (
        f"learns from {len(images)} mirror images too, since {meshes.names[found[1]]} is symmetric; "
        "collection.mirror = false leaves them out"
    )
    return images, original_index, [note] if len(images) else []


def _prolong(
    run: RunDirectory,
    meshes: MeshCollection,
    reference: TriangleMesh,
    fine: TriangleMesh,
    coarse: FloatArray,
    exact: FloatArray,
    held: IntArray,
) -> dict[str, Any]:
    """``prolongation.npz``, and how far it is from the fine shapes (n, Vf, 3) given the coarse ones (n, V, 3).

    Its weights are fitted to the shapes, if those fitted to the others come closer to the shapes ``held``; the figures
    are of these. The reference is not among them: there it is exact.
    """
    own = np.unique(meshes.shell_faces)
    riders = []
    for part in meshes.parts[1:]:
        index = np.setdiff1d(meshes.faces[part.faces], own)
        riders.append(attach_part(reference, fine.vertices[index], index, coarse, some_vertices(exact, index)))
    prolong = trial = Prolongation.of(reference, fine, riders)
    every = np.arange(len(exact))
    fitted = prolong.fitted(coarse, exact, own, np.setdiff1d(every, held))
    learned, plain = (each.errors(coarse[held], (exact[k] for k in held)) for each in (fitted, prolong))
    if learned["mean"] < plain["mean"]:
        prolong, trial = prolong.fitted(coarse, exact, own, every), fitted
    run.prolongation.write(**prolong.arrays())
    facts: dict[str, Any] = {"prolongation": min(learned, plain, key=lambda errors: errors["mean"])}
    if riders:
        indices = [own, *(rider.vertices for rider in riders)]
        found = np.array(
            [
                [(away[index].mean(), away[index].max()) for index in indices]
                for away in trial.distances(coarse[held], (exact[k] for k in held))
            ]
        )
        how = ["shell", *("rigidly" if rider.rigid else "affinely" for rider in riders)]
        facts["prolongation"]["parts"] = [
            {"name": part.name, "carried": carried, "mean": mean, "max": most}
            for part, carried, mean, most in zip(
                meshes.parts, how, found[..., 0].mean(axis=0).tolist(), found[..., 1].max(axis=0).tolist(), strict=True
            )
        ]
    return facts


def write_reference(run: RunDirectory, mesh: TriangleMesh, scale: float, **fine: np.ndarray) -> None:
    """``reference.npz``, see RunDirectory.reference."""
    run.reference.write(vertices=mesh.vertices, faces=mesh.faces, edges=mesh.edges, scale=np.array(scale), **fine)


class MeanError(ValueError):
    """A collection without a mean, with a sentence that says where and what to do."""


def mean(run: RunDirectory, config: Config) -> dict[str, Any]:
    """``mean.npz``: the elastic mean of all shapes, centred: where the tangent space is attached; and K.

    Raises:
        MeanError: it isn't found.
    """
    reference, given = run.reference_mesh(), run.shapes.read()
    shapes = given["vertices"]
    steps = time_steps(config.modes, reference, shapes, material(config), given["original"])
    found = centred_mean(reference, shapes, material(config), min(LIGHT_STEPS, steps))
    if found.status is not Status.CONVERGED:
        raise MeanError(_where(run, found))
    facts = {"status": str(found.status), "iterations": found.iterations, "residual": found.residual, "steps": steps}
    # Shapes are served where the mean stands, which has to be where the reference stands in its file.
    vertices = align(found.vertices, reference.vertices)
    run.mean.write(vertices=vertices, **{k: np.array(v) for k, v in facts.items()})
    return facts


def _where(run: RunDirectory, found: Mean) -> str:
    """Which place of which shape keeps a mean from being found, and what to do about it."""
    if found.worst is None:
        return f"the shapes have no mean: {found.reason}"
    shape, face = found.worst
    reference, shapes = run.reference.read(), run.shapes.read()
    file, first = shapes["files"][shape], shapes["first"][shape]
    vertex = int(reference["faces"][face, 0])
    position = float(reference["scale"]) * shapes["vertices"][shape, vertex]
    number = int(reference["fine_index"][vertex]) if "fine_index" in reference else vertex
    if "file_vertices" in reference:
        number = int(np.flatnonzero(reference["file_vertices"] == number)[0])
    here, there = (face_areas(x, reference["faces"])[face] for x in (shapes["vertices"][shape], found.vertices))
    return (
        f"the shapes have no mean: {found.reason}. Of all faces, one of {file} at its vertex "
        f"{number + first} (counted from {first}), at ({', '.join(f'{x:.6g}' for x in position)}), is "
        "furthest from the others' with "
        f"{here / there if there else np.inf:.1e} of the area in the mean so far. Mend the mesh there, take this shape "
        "out of the folder, or change coarse_vertices in the configuration so that another vertex is kept"
    )


def modes(run: RunDirectory, config: Config) -> dict[str, Any]:
    """``modes-by-strength.npz`` and ``modes.json``: the shapes' logarithms, sparse and principal modes.

    ``modes.npz`` holds the same until `factors` puts them in its order.
    """
    settings, centre, given = config.modes, run.mean_mesh(), run.shapes.read()
    shapes, original_index = given["vertices"], given["original"]
    space = ShellSpace(centre, material(config))
    norm = WeightedNorm.of(centre, config.material.eta)
    steps = _steps(run)
    found = logarithms(space, centre.vertices, shapes, steps)
    count = mode_count(settings, space, centre.vertices, found.fields, original_index)
    dense = pga(space, centre.vertices, found.fields, count, settings.norm)
    with waiting("sparse modes"):
        sparse = find_modes(settings, space, centre.vertices, found.fields, count, original_index)
    codes = nearest_codes(space, centre.vertices, sparse.vertices, shapes, sparse.coefficients, steps)
    lower, upper = box_of(codes.codes)
    arrays = {
        "nric": sparse.nric,
        "vertices": sparse.vertices,
        "coefficients": codes.codes[: original_index.max() + 1],
        "mirrored_coefficients": codes.codes[original_index.max() + 1 :],
        "lower": lower,
        "upper": upper,
        "localisation": localisation(sparse.nric, norm),
        "pga_nric": dense.nric,
        "pga_vertices": dense.vertices,
        "pga_localisation": localisation(dense.nric, norm),
    }
    run.modes_by_strength.write(**arrays)
    run.modes.write(**arrays, rank=np.arange(len(sparse)))
    facts = {
        "modes": len(sparse),
        "converged": sparse.converged,
        "explained": sparse.explained,
        "sparsity": sparse.sparsity,
        "pga_explained": dense.explained,
        "linearised_logarithms": len(found.fallbacks),
        "asked": count if settings.count == "auto" else settings.count,
        "log_steps": steps,
        "steps": list(found.steps),
        "via": list(found.via),
        "codes": [str(status) for status in codes.status],
        "left": summary(
            vertex_distances(codes.vertices, shapes, run.reference_mesh().diagonal)[: original_index.max() + 1]
        ),
    }
    run.decomposition.write(facts | {"reasons": list(found.reasons), "history": sparse.history})
    return facts


def _steps(run: RunDirectory) -> int:
    """K that was chosen with the mean."""
    return int(run.mean.read()["steps"])


def generalisation(run: RunDirectory, config: Config) -> dict[str, Any]:
    """``generalisation.json``: how near modes of a part of the shapes come to the others, beside principal components.

    A fifth of the shapes is held out of everything: mean, logarithms, modes and their number; or below ten each in its
    turn. Exponentials stand for networks, in at most LIGHT_STEPS steps. With half as many modes too. And
    ``least-general.npz``, the shape that is farthest.
    """
    reference, given, settings = run.reference_mesh(), run.shapes.read(), config.modes
    shapes, original = given["vertices"], given["original"]
    parts = some_folds(int(original.max()) + 1)
    try:
        found = joined(
            [held_out(reference, shapes, index, None, settings, material(config), original=original) for index in parts]
        )
    except (ModeError, NotPositiveDefiniteError) as error:  # no reason to do without a model
        facts: dict[str, Any] = {"failed": str(error)}
    else:
        away = found.distances(shapes, reference.diagonal)
        worst = int(away["modes"][-1].mean(axis=1).argmax())
        number = found.index[worst]
        run.least_general.write(given=shapes[number], found=found.by_modes[-1][worst])
        different = slice(0 if found.counts[0] < found.counts[1] else 1, None)
        ended = ~found.stuck[-1]
        facts = {
            "held_out": len(found.index),
            "steps": int(found.steps.max()),
            "counts": found.counts[different],
            **{name: [summary(each) for each in rows[different]] for name, rows in away.items()},
            "stuck": int((~ended).sum()),
            "not_stuck": {name: summary(rows[-1][ended]) for name, rows in away.items() if ended.any()},
            "worst": str(given["names"][number]),
        }
    run.generalisation.write(facts)
    return facts


def compactness_and_specificity(run: RunDirectory) -> dict[str, dict[str, float]]:
    """Of the space, ``modes``, beside as many principal ``components`` of the aligned vertices (Davies et al. 2002).

    Compactness is the share of the variance that they explain, of logarithms or of vertices. Specificity is the mean
    distance of random shapes, in the bounds of codes or of coefficients, from the nearest of the collection, as a share
    of the diagonal: the first joint samples, which are learned from.
    """
    shapes, reference, found = run.own_shapes(), run.reference_mesh(), run.decomposition.read()
    # Only as many files as are needed: all samples may be gigabytes.
    random = itertools.chain.from_iterable(part["vertices"][part["status"] == DONE] for part in parts(run.samples))
    drawn = np.array(list(itertools.islice(random, RANDOM)), dtype=np.float64)
    linear = PrincipalComponents.of(shapes, reference.vertices)
    others = linear.random(found["modes"], len(drawn), np.random.default_rng(0))
    away = [to_nearest(each, shapes, reference.diagonal) for each in (drawn, others)]
    return {
        "compactness": {"modes": found["explained"], "components": linear.explained(found["modes"])},
        "specificity": dict(zip(("modes", "components"), away, strict=True)),
    }


def factors(run: RunDirectory, config: Config) -> dict[str, Any]:
    """``factors.json``, groups of modes with overlapping supports, and ``modes.npz``, the modes in their order.

    In that order each factor's latents are a range, as bundles want them.
    """
    found, centre = run.modes_by_strength.read(), run.mean_mesh()
    norm = WeightedNorm.of(centre, config.material.eta)
    z = np.ascontiguousarray(found["nric"])  # sums round by the order in memory, and files keep that
    shared = overlap(z, norm)
    groups = group(shared, config.factors.count)
    order = [j for members in groups for j in members]
    ordered = {name: found[name][order] for name in ("nric", "vertices", "lower", "upper", "localisation")}
    ordered |= {name: found[name][:, order] for name in ("coefficients", "mirrored_coefficients")}
    ordered["rank"] = np.array(order)
    run.modes.write(**found | ordered)
    starts = np.cumsum([0, *map(len, groups)])
    run.factors.write(
        {
            "factors": [list(range(a, b)) for a, b in itertools.pairwise(starts.tolist())],
            "names": names(groups, z, norm, centre),
            "overlap": between(shared, groups).tolist(),
        }
    )
    return {"factors": len(groups), "largest": max(map(len, groups))}


def encoded(run: RunDirectory, config: Config, bundle: Path) -> dict[str, Any]:
    """``encoded.json``: how near a bundle's codes come to the shapes of the collection, and which are out of bounds.

    By ``encode`` as it is served, beside what modes leave without networks and without what a bundle remembers. And
    ``least-near.npz``, the farthest.
    """
    model, reference, names = shapespace.load(bundle), run.reference_mesh(), run.shapes.read()["names"]
    given, scale = run.own_shapes(), float(run.reference.read()["scale"])
    found = [model.encode(scale * shape) for shape in progress(given, "codes of the shapes", "shape", len(given))]
    near = np.stack([each.shape.vertices for each in found]) / scale
    linear = PrincipalComponents.of(given, reference.vertices).nearest(given, model.latents.dimension)
    away, other = (vertex_distances(each, given, reference.diagonal) for each in (near, linear))
    worst = int(away.mean(axis=1).argmax())
    facts = summary(away) | {
        "components": summary(other),
        "modes": run.decomposition.read().get("left"),
        "remembered": config.export.examples,
        "shapes": len(given),
        "outside": [str(name) for name, each in zip(names, found, strict=False) if not each.inside_bounds],
        "worst": str(names[worst]),
    }
    run.least_near.write(given=given[worst], found=near[worst])
    run.encoded.write(facts)
    return facts


def _known_codes(modes: dict[str, np.ndarray]) -> FloatArray:
    """(n, m) of all shapes that were learned from, mirror images last."""
    return np.concatenate([modes["coefficients"], modes["mirrored_coefficients"]])


def collection(run: RunDirectory, config: Config) -> ShellCollection:
    """The collection that the stages found."""
    factors, modes = run.factors.read(), run.modes.read()
    return ShellCollection(
        reference=run.mean_mesh(),
        modes=modes["vertices"],
        lower=modes["lower"],
        upper=modes["upper"],
        factors=dict(zip(factors["names"], factors["factors"], strict=True)),
        steps=config.samples.steps or _steps(run),
        material=material(config),
        scale=float(run.reference.read()["scale"]),
        codes=_known_codes(modes),
    )


def examples(run: RunDirectory) -> tuple[FloatArray, FloatArray]:
    """Codes (n, m) of all shapes that were learned from, mirror images last, and their lengths and angles (n, 2E)."""
    return _known_codes(run.modes.read()), nric(run.shapes.read()["vertices"], run.reference_mesh().connectivity)


def geometry(run: RunDirectory) -> Geometry:
    """What the bundle's geometry holds: the mean, the fine mesh there, the modes, and the codes of the shapes."""
    mean, reference, modes = run.mean_mesh(), run.reference.read(), run.modes.read()
    fine = None
    if run.prolongation.exists():
        prolong = Prolongation.from_arrays(run.prolongation.read())
        fine = FineMesh(TriangleMesh.from_arrays(prolong(mean.vertices), reference["fine_faces"]), prolong)
    return Geometry(
        reference=mean,
        fine=fine,
        modes=modes["vertices"],
        training_codes=_known_codes(modes),
        file_vertices=reference.get("file_vertices"),
        surface=_surface(run),
    )


def _surface(run: RunDirectory) -> MeshAttributes | None:
    if not run.surface_names.exists():
        return None
    entry, arrays = AttributesEntry.model_validate(run.surface_names.read()), run.surface.read()
    return from_entry(entry, arrays, {name: arrays[name].tobytes() for name in entry.textures})
