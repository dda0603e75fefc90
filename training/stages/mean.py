"""Stage `mean`: the mean shape, where the tangent space is attached, and the number of time steps K."""

from dataclasses import asdict

import numpy as np

from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import face_areas
from shapespace.shell.mean import Mean
from shapespace.solve.outcome import Status
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.generalisation import LIGHT_STEPS
from shapespace.training.space.geometry import choose_geometry
from shapespace.training.space.mean import centred_mean
from shapespace.training.space.modes import ModeError
from shapespace.training.space.related import Related
from shapespace.training.space.straight_lines import StraightLines
from shapespace.training.stages.stage import Run, Stage


class MeanError(ValueError):
    """A collection without a mean. The message says where it fails and what to do."""


def find_mean(run: Run) -> None:
    """Write ``mean.npz``: the centred elastic mean of all shapes, and K.

    Unless the configuration asks for exponentials, write ``geometry.json``. On straight lines the mean is their shape
    of the code 0.

    Raises MeanError if the mean is not found.
    """
    directory, material = run.directory, run.config.shell_material
    reference, given = directory.reference_mesh(), directory.shapes.read()
    shapes = given["vertices"]
    first_step = run.config.exponential.first_step
    try:
        choice = choose_geometry(run.config.modes, reference, shapes, material, Related.of_arrays(given), first_step)
    except ModeError as error:
        raise MeanError(
            f"the shapes have no mean of the kind that modes.geometry asks for: {error}; choose another modes.geometry"
        ) from None
    if run.config.modes.geometry != "exponential":
        directory.geometry.write(asdict(choice))
        directory.log("chosen", **asdict(choice))
    steps = choice.steps
    if choice.kind != "exponential":
        lines = StraightLines.of(choice.kind, shapes, reference)
        status = str(Status.CONVERGED)
        directory.mean.write(vertices=lines.reference.vertices, status=np.array(status), steps=np.array(steps))
        return
    found = centred_mean(reference, shapes, material, min(LIGHT_STEPS, steps), first_step=first_step)
    if found.status is not Status.CONVERGED:
        raise MeanError(_describe_failure(directory, found))
    facts = {"status": str(found.status), "iterations": found.iterations, "residual": found.residual, "steps": steps}
    # Shapes are served at the position of the mean, which has to be the position of the reference in its file.
    vertices = align(found.vertices, reference.vertices)
    directory.mean.write(vertices=vertices, **{k: np.array(v) for k, v in facts.items()})
    directory.log("found", **facts)


def _describe_failure(run: RunDirectory, found: Mean) -> str:
    """Name the place of the shape that keeps the mean from being found, and say what to do about it."""
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
        f"the shapes have no mean: {found.reason}. The face that differs most from the other shapes is in {file}, at "
        f"its vertex {number + first} (counted from {first}), at ({', '.join(f'{x:.6g}' for x in position)}). Its "
        f"area is {here / there if there else np.inf:.1e} times the area in the mean so far. Correct the mesh there, "
        "remove this shape from the folder, or change collection.coarse_vertices so that another vertex is kept"
    )


def _choice_settings(modes: ModeSettings) -> ModeSettings:
    """Return ``log_steps``, or where K is chosen the number of modes by which it is chosen.

    Where the map from codes to shapes is chosen too, return all that decides.
    """
    decide = {"log_steps"} if modes.log_steps != "auto" else {"count"}
    if modes.geometry != "exponential":
        decide = {"geometry", "count", "log_steps", "norm"}
    return ModeSettings(**modes.model_dump(include=decide))


STAGE = Stage(
    name="mean",
    version=3,
    # Without the table for the paper's first step: runs of version 0.2 had none, and are done.
    settings=lambda config: [
        config.material,
        _choice_settings(config.modes),
        *([] if config.exponential.first_step == "paper" else [config.exponential]),
    ],
    run=find_mean,
    results=lambda run: [run.mean.path, run.geometry.path],
    meshes_only=True,
)
