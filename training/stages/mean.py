"""Stage `mean`: the mean shape, where the tangent space is attached, and the number of time steps K."""

import numpy as np

from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import face_areas
from shapespace.shell.mean import Mean
from shapespace.solve.outcome import Status
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.generalisation import LIGHT_STEPS, time_steps
from shapespace.training.space.mean import centred_mean
from shapespace.training.stages.stage import Run, Stage


class MeanError(ValueError):
    """A collection without a mean. The message says where it fails and what to do."""


def find_mean(run: Run) -> None:
    """Write ``mean.npz``: the centred elastic mean of all shapes, and K. Raises MeanError if the mean is not found."""
    directory, material = run.directory, run.config.shell_material
    reference, given = directory.reference_mesh(), directory.shapes.read()
    shapes = given["vertices"]
    first_step = run.config.exponential.first_step
    steps = time_steps(run.config.modes, reference, shapes, material, given["original"], first_step)
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


def _step_settings(modes: ModeSettings) -> ModeSettings:
    """Return ``log_steps``, or where K is chosen the number of modes by which it is chosen."""
    if modes.log_steps == "auto":
        return ModeSettings(count=modes.count)
    return ModeSettings(log_steps=modes.log_steps)


STAGE = Stage(
    name="mean",
    version=3,
    # Without the table for the paper's first step: runs of version 0.2 had none, and are done.
    settings=lambda config: [
        config.material,
        _step_settings(config.modes),
        *([] if config.exponential.first_step == "paper" else [config.exponential]),
    ],
    run=find_mean,
    results=lambda run: [run.mean.path],
    meshes_only=True,
)
