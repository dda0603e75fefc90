"""The stages: where a collection has no mean the message names the place, and steps are chosen with the mean."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.config import parse
from shapespace.training.space.factors import FactorError
from shapespace.training.space.geometry import GeometryChoice
from shapespace.training.stages.ingest import write_reference
from shapespace.training.stages.mean import MeanError, find_mean
from shapespace.training.stages.run import STAGES
from shapespace.training.stages.stage import Run

CONFIG = """
[collection]
data = "meshes"

[export]
name = "balls"
title = "Balls"
description = ""
licence = "MIT"
"""


def test_a_run_without_a_mean_ends_with_the_place(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = TriangleMesh.from_arrays(ball.vertices / np.sqrt(ball.area), ball.faces)
    shapes = np.stack([mesh.vertices * [1, 1, s] for s in (1, 1.1, 1.2)])
    i, j = mesh.edges[20]
    shapes[1, i] = shapes[1, j]
    # Coarse vertex v is fine vertex 2 v + 1; files have 5 more vertices, which no face uses.
    fine_index = 2 * np.arange(len(mesh.vertices)) + 1
    file_vertices = np.concatenate([np.full(5, -1), np.arange(2 * len(mesh.vertices))])
    run = Run(tmp_path, parse(CONFIG, "balls.toml"), CONFIG, tmp_path / "models")
    write_reference(run.directory, mesh, 10.0, fine_index=fine_index, file_vertices=file_vertices)
    names = np.array(["one", "two", "three"])
    files, first = np.array(["one.obj", "two.obj", "three.ply"]), np.array([1, 1, 0])
    run.directory.shapes.write(names=names, vertices=shapes, files=files, first=first, original=np.arange(3))
    with pytest.raises(MeanError) as error:
        find_mean(run)
    faces = mesh.faces[[{i, j} <= set(face) for face in mesh.faces]]
    places = [
        f"is in two.obj, at its vertex {2 * v + 1 + 5 + 1} (counted from 1), at ({x:.6g}, {y:.6g}, {z:.6g}). "
        for v, (x, y, z) in ((v, 10 * shapes[1, v]) for v in faces.ravel())
    ]
    assert sum(place in str(error.value) for place in places) >= 1
    assert "coarse_vertices" in str(error.value)
    assert not run.directory.mean.exists()
    run.directory.shapes.write(names=np.array(["one", "three"]), vertices=shapes[[0, 2]], original=np.arange(2))
    find_mean(run)
    found = run.directory.mean.read()
    assert (found["status"], found["steps"]) == ("converged", 8)


@pytest.mark.parametrize(("given", "steps"), [(None, 1), pytest.param(3, 3, marks=pytest.mark.long)])
def test_codes_of_a_run_stand_for_exponentials_of_the_steps_that_were_chosen(
    blends: tuple[TriangleMesh, np.ndarray], tmp_path: Path, given: int | None, steps: int
) -> None:
    mesh, shapes = blends
    source = CONFIG + ("" if given is None else f"[samples]\nsteps = {given}\n")
    run = Run(tmp_path, parse(source, "balls.toml"), source, tmp_path / "models")
    write_reference(run.directory, mesh, 10.0)
    run.directory.shapes.write(
        names=np.arange(len(shapes)).astype(str), vertices=shapes, original=np.arange(len(shapes))
    )
    for name in ("mean", "modes", "factors"):
        STAGES[name].run(run)
    found = run.collection
    assert found.steps == steps
    code = 0.3 * found.upper
    straight = found.reference.vertices + np.tensordot(code, found.modes, axes=1)
    away = np.abs(align(found.shapes(code[None]).vertices[0], straight) - straight).max()
    assert away < 1e-12 if steps == 1 else away > 1e-4
    assert (found.limit is None) == (steps == 1), "one step approximates no geodesic"

    source += "[factors]\nmodes = [[2, 5, 7], [1, 0], [3, 4, 6]]\n"
    run = Run(tmp_path, parse(source, "balls.toml"), source, tmp_path / "models")
    STAGES["factors"].run(run)
    assert run.directory.factors.read()["factors"] == [[0, 1, 2], [3, 4], [5, 6, 7]]
    assert run.directory.modes.read()["rank"].tolist() == [2, 5, 7, 1, 0, 3, 4, 6]
    source += '[export.names]\nhead = "top"\n'
    run = Run(tmp_path, parse(source, "balls.toml"), source, tmp_path / "models")
    with pytest.raises(FactorError, match=r"export.names has 'head', .* There are \".*\", \""):
        STAGES["factors"].run(run)


def test_modes_have_the_number_and_the_local_fields_that_were_chosen_for_exponentials(
    blends: tuple[TriangleMesh, np.ndarray], tmp_path: Path
) -> None:
    mesh, shapes = blends
    source = CONFIG + "[modes]\nsparsity = 0\nlog_steps = 1\n"
    run = Run(tmp_path, parse(source, "balls.toml"), source, tmp_path / "models")
    write_reference(run.directory, mesh, 10.0)
    names = np.arange(len(shapes)).astype(str)
    run.directory.shapes.write(names=names, vertices=shapes, original=np.arange(len(shapes)))
    STAGES["mean"].run(run)
    STAGES["modes"].run(run)
    alone = run.directory.decomposition.read()
    assert alone["local_share"] == 0
    more = alone["modes"] + 2
    chosen = GeometryChoice("exponential", 1, more, local_share=0.1, unseen_share=0.1)
    run.directory.geometry.write(asdict(chosen))
    STAGES["modes"].run(run)
    found = run.directory.decomposition.read()
    assert (found["modes"], found["local_share"]) == (more, 0.1)
