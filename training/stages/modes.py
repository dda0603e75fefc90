"""Stage `modes`: logarithms of the shapes at the mean, their sparse and principal modes, and codes of the shapes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm
from shapespace.counted import counted
from shapespace.shell.space import ShellSpace
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.space.codes import Codes, box_of, enough_steps, nearest_codes
from shapespace.training.space.generalisation import summary, vertex_distances
from shapespace.training.space.geometry import GeometryChoice, straight_lines
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.modes import localisation, mode_count
from shapespace.training.space.related import Related
from shapespace.training.space.sparse_modes import find_modes
from shapespace.training.stages.stage import Run, Stage, StageWarning, against_failures, listed


def decompose(run: Run) -> None:
    """Write ``modes-by-strength.npz``, ``modes.json``, and ``modes.npz``, which `factors` puts in its order. Raises
    ModeError if the collection has no modes, or none at this sparsity.
    """
    directory, config = run.directory, run.config
    if directory.straight_kind():
        _straighten(run)
        return
    settings, centre, given = config.modes, directory.mean_mesh(), directory.shapes.read()
    shapes, related = given["vertices"], Related.of_arrays(given)
    space = ShellSpace(centre, config.shell_material, first_step=config.exponential.first_step)
    norm = WeightedNorm.of(centre, config.material.eta)
    steps = directory.log_steps()
    found = logarithms(space, centre.vertices, shapes, steps)
    own = mode_count(settings, space, centre.vertices, found.fields, related)
    count, local = own.count, own.local
    if local is None and (written := directory.geometry.read_if_written()):
        chosen = GeometryChoice(**written)
        count, local = chosen.count or count, chosen.local
    plain = settings.model_copy(update={"sparsity": 0})
    dense, sparse = (
        find_modes(each, space, centre.vertices, found.fields, count, related, local.share if local else 0.0)
        for each in (plain, settings)
    )
    shooting = steps
    if settings.log_steps == "auto" and space.first_step == "centred" and steps > 1:
        shooting = enough_steps(space, centre.vertices, sparse.vertices, sparse.coefficients)
    codes = nearest_codes(space, centre.vertices, sparse.vertices, shapes, sparse.coefficients, shooting)
    arrays = {
        "nric": sparse.nric,
        "vertices": sparse.vertices,
        "localisation": localisation(sparse.nric, norm),
        "pga_nric": dense.nric,
        "pga_vertices": dense.vertices,
        "pga_localisation": localisation(dense.nric, norm),
    }
    facts = {
        "modes": len(sparse),
        "converged": sparse.converged,
        "explained": sparse.explained,
        "sparsity": sparse.sparsity,
        "pga_explained": dense.explained,
        "linearised_logarithms": len(found.fallbacks),
        "asked": count if settings.count == "auto" else settings.count,
        "local_share": local.share if local else 0.0,
        "log_steps": steps,
        "exponential_steps": shooting,
        "steps": list(found.steps),
        "via": list(found.via),
    }
    room = None if sparse.spread is None or local is None else local.room(sparse.spread)
    _write(directory, arrays, codes, room, facts, reasons=list(found.reasons), history=sparse.history)


def _straighten(run: Run) -> None:
    """Write the same files for straight lines. Their modes are principal, and need no logarithm."""
    directory, chosen = run.directory, GeometryChoice(**run.directory.geometry.read())
    shapes, centre = directory.shapes.read()["vertices"], directory.mean_mesh()
    every = straight_lines(chosen, shapes, directory.reference_mesh(), directory.vertex_counts())
    lines = every.first(chosen.count or len(every))
    arrays = {
        "nric": lines.nric,
        "vertices": lines.fields,
        "mean": lines.mean,
        **({"differential": lines.modes} if lines.kind == "differential" else {}),
        "localisation": localisation(lines.nric, WeightedNorm.of(centre, run.config.material.eta)),
    }
    explained = float(every.explained[: len(lines)].sum())
    facts = {
        "modes": len(lines),
        "converged": True,
        "explained": explained,
        "sparsity": 0.0,
        "pga_explained": explained,
        "linearised_logarithms": 0,
        "asked": len(lines) if run.config.modes.count == "auto" else run.config.modes.count,
        "local_share": chosen.local_share,
        "log_steps": 1,
        "steps": [1] * len(shapes),
    }
    room = None if lines.spread is None or chosen.local is None else chosen.local.room(lines.spread)
    _write(directory, arrays, lines.nearest(shapes), room, facts, history=[])


def _write(
    directory: RunDirectory,
    arrays: Mapping[str, NDArray],
    found: Codes,
    room: FloatArray | None,
    facts: Mapping[str, Any],
    **details: Any,
) -> None:
    """Write modes, the codes of the shapes with their bounds, and facts. ``details`` are too long for the log.

    Bounds also have ``room`` (m,) on each side for what single regions do.
    """
    given = directory.shapes.read()
    shapes, originals = given["vertices"], int(given["original"].max()) + 1
    around = np.empty((0, found.codes.shape[1])) if room is None else np.stack([-room, room])
    lower, upper = box_of(np.concatenate([found.codes, around]))
    coefficients = {"coefficients": found.codes[:originals], "mirrored_coefficients": found.codes[originals:]}
    every = {**arrays, **coefficients, "lower": lower, "upper": upper}
    directory.modes_by_strength.write(**every)
    directory.modes.write(**every, rank=np.arange(len(every["nric"])))
    away = vertex_distances(found.vertices, shapes, directory.reference_mesh().diagonal)[:originals]
    told = {**facts, "codes": [str(status) for status in found.status], "left": summary(away)}
    directory.decomposition.write(told | details)
    directory.log("found", **told)


def _warnings(run: RunDirectory) -> list[StageWarning]:
    facts = run.decomposition.read_if_written()
    if "steps" not in facts:
        return []
    names = run.shapes.read()["names"].astype(str)
    steps, asked, found = np.array(facts["steps"]), facts["asked"], facts["modes"]
    warnings = []
    linearised = names[steps == 0].tolist()
    if linearised:
        sentence = (
            f"for {len(linearised)} of {len(steps)} shapes no geodesic was found, so a straight line replaces "
            f"it: {listed(linearised)}"
        )
        warnings.append(StageWarning(sentence, len(linearised) / len(steps), against_failures(run)))
    finer = names[steps > facts["log_steps"]].tolist()
    if finer:
        sentence = f"{len(finer)} of {len(steps)} logarithms needed more time steps: {listed(finer)}"
        warnings.append(StageWarning(sentence))
    if found < asked:
        why = (
            f"{len(steps)} shapes differ in {counted(found, 'direction')}"
            if found == len(steps) - 1
            else "the others would be zero; a smaller modes.sparsity keeps more, unless it is 0 already"
        )
        warnings.append(StageWarning(f"found {found} of {asked} modes, because {why}"))
    unfinished = names[np.array(facts.get("codes", ["converged"] * len(names))) != "converged"].tolist()
    if unfinished:
        sentence = (
            f"the search for the codes of {len(unfinished)} of {len(names)} shapes did not converge: "
            f"{listed(unfinished)}"
        )
        warnings.append(StageWarning(sentence))
    if not facts.get("converged", True):
        sentence = "sparse modes: the iteration did not converge within modes.max_iterations; a larger number may help"
        warnings.append(StageWarning(sentence))
    return warnings


STAGE = Stage(
    name="modes",
    version=2,
    settings=lambda config: [config.modes],
    run=decompose,
    results=lambda run: [run.modes_by_strength.path, run.modes.path, run.decomposition.path],
    warnings=_warnings,
    meshes_only=True,
)
