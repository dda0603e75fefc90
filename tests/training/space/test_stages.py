"""The stage mean: where a collection has none, the message names the place; otherwise it converges."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.config import parse
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.space.stages import MeanError, mean, write_reference

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
    run = RunDirectory(tmp_path)
    write_reference(run, mesh, 10.0, fine_index=fine_index, file_vertices=file_vertices)
    names = np.array(["one", "two", "three"])
    files, first = np.array(["one.obj", "two.obj", "three.ply"]), np.array([1, 1, 0])
    run.shapes.write(names=names, vertices=shapes, files=files, first=first)
    with pytest.raises(MeanError) as error:
        mean(run, parse(CONFIG, "balls.toml"))
    faces = mesh.faces[[{i, j} <= set(face) for face in mesh.faces]]
    places = [
        f"one of two.obj at its vertex {2 * v + 1 + 5 + 1} (counted from 1), at ({x:.6g}, {y:.6g}, {z:.6g}), "
        for v, (x, y, z) in ((v, 10 * shapes[1, v]) for v in faces.ravel())
    ]
    assert sum(place in str(error.value) for place in places) >= 1
    assert "coarse_vertices" in str(error.value)
    assert not run.mean.exists()
    run.shapes.write(names=np.array(["one", "three"]), vertices=shapes[[0, 2]])
    assert mean(run, parse(CONFIG, "balls.toml"))["status"] == "converged"
