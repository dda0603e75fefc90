"""The stage `ingest`: which meshes are simplified, and what it says about the coarse mesh."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.training.runs.config import parse
from shapespace.training.stages.run import STAGES
from shapespace.training.stages.stage import Run

CONFIG = """
[collection]
data = {data}
coarse_vertices = {vertices}
mirror = false

[export]
name = "balls"
title = "Balls"
description = ""
licence = "MIT"
"""


def ingested(folder: Path, vertices: int, stretch: float = 1.0) -> tuple[Run, list[str]]:
    """A run of balls of 162 vertices, and the sentences of its first stage."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    return ingested_shapes(folder, vertices, ball, [ball.vertices * [stretch, 1, size] for size in (1, 1.1, 1.2)])


def ingested_shapes(
    folder: Path, vertices: int, ball: trimesh.Trimesh, shapes: list[np.ndarray]
) -> tuple[Run, list[str]]:
    np.savez(folder / "balls.npz", vertices=np.stack(shapes), faces=ball.faces)
    text = CONFIG.format(data=json.dumps(str(folder / "balls.npz")), vertices=vertices)
    run = Run(folder / "run", parse(text, "balls.toml"), text, folder / "models")
    run.directory.begin()
    STAGES["ingest"].run(run)
    return run, [warning.sentence for warning in STAGES["ingest"].warnings(run.directory)]


@pytest.mark.parametrize(("asked", "kept"), [(108, 162), (107, 107)])
def test_a_mesh_keeps_its_vertices_up_to_one_and_a_half_times_the_number(asked: int, kept: int, tmp_path: Path) -> None:
    run, sentences = ingested(tmp_path, asked)
    assert len(run.directory.reference_mesh().vertices) == kept
    assert run.directory.prolongation.exists() == (kept < 162)
    assert not any("coarse mesh" in sentence for sentence in sentences)


def test_flat_angles_of_the_coarse_mesh_are_told(tmp_path: Path) -> None:
    run, sentences = ingested(tmp_path, 60, stretch=100)
    angle = run.directory.ingest.read()["smallest_angle"]
    assert angle < 2
    assert any(f"the smallest angle of a face is {angle:.1f}°" in sentence for sentence in sentences)


def test_sums_of_fields_come_back_on_the_fine_mesh(tmp_path: Path) -> None:
    """Fine detail on top of fitted weights alone would miss four times as much."""
    ball, rng = trimesh.creation.icosphere(subdivisions=3), np.random.default_rng(2)
    fields = [np.sin(2 * ball.vertices @ rng.normal(size=(3, 3)) + rng.normal(size=3)) for _ in range(4)]
    codes = 0.04 * rng.uniform(-1, 1, (30, 4))
    run, _ = ingested_shapes(tmp_path, 100, ball, list(ball.vertices + np.tensordot(codes, fields, 1)))
    assert len(run.directory.reference_mesh().vertices) == 100
    assert run.directory.ingest.read()["prolongation"]["mean"] < 4e-5
    counts = run.directory.vertex_counts()
    assert (counts.sum(), len(counts)) == (642, 100)
