"""Soft fields: cheap directions beside the modes of a small collection."""

from pathlib import Path

import numpy as np
import pytest

import shapespace
from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import rigid_motions
from shapespace.mesh.triangle_mesh import TriangleMesh, vertex_areas
from shapespace.shell.energy import Material
from shapespace.shell.space import ShellSpace
from shapespace.training.collection.generators import figure
from shapespace.training.report.page import write_report
from shapespace.training.runs.config import parse
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.generalisation import PrincipalComponents, vertex_distances
from shapespace.training.space.geometry import choose_geometry, straight_lines
from shapespace.training.space.held_out import held_out
from shapespace.training.space.modes import most_modes
from shapespace.training.space.soft_fields import soft_fields
from shapespace.training.space.straight_lines import StraightKind, StraightLines
from shapespace.training.stages.run import execute
from shapespace.training.stages.stage import Run

AUTO = ModeSettings(geometry="auto")
KNOWN = 8


@pytest.fixture(scope="module")
def waves(ellipsoid: TriangleMesh) -> FloatArray:
    """Eight shapes and eight others (n, V, 3), each moved by waves of its own."""
    rng, x = np.random.default_rng(3), ellipsoid.vertices
    moved = [np.sin(1.5 * x @ rng.standard_normal((3, 3)) + rng.uniform(0, 6, 3)) for _ in range(2 * KNOWN)]
    return x + 0.08 * np.stack(moved)


def test_soft_fields_are_the_cheapest_directions(ellipsoid: TriangleMesh) -> None:
    space, x = ShellSpace(ellipsoid, Material()), ellipsoid.vertices
    fields = soft_fields(space, x)
    assert (fields == soft_fields(space, x)).all(), "the same fields at each call"
    areas = vertex_areas(x, ellipsoid.faces)
    flat, weights = fields.reshape(len(fields), -1), np.repeat(areas, 3)
    scale = np.abs(flat * weights).max()
    assert np.abs((flat * weights) @ rigid_motions(x).T).max() < 1e-4 * scale, "no rigid motion"
    rest = space.energy.rest(space.nric(x))

    def stiffness(field: FloatArray) -> float:
        size = 1e-3 / np.abs(field).max()
        return float(rest.value(space.nric(x + size * field))) / size**2

    costs = [stiffness(field) for field in fields]
    assert costs == pytest.approx([costs[0]] * len(costs), rel=0.05), "a softer field moves farther"
    wave = np.sin(3 * x)
    farther = np.sqrt(weights @ fields[5].ravel() ** 2 / (weights @ wave.ravel() ** 2))
    assert stiffness(farther * wave) > 2 * costs[5]


def test_parts_do_not_move_apart(ellipsoid: TriangleMesh) -> None:
    """Each part moves at no cost. These motions are no soft fields, because they would hide all others."""
    x, away = ellipsoid.vertices, ellipsoid.vertices + np.array([0, 5, 0])
    faces = np.concatenate([ellipsoid.faces, ellipsoid.faces + len(x)])
    two = TriangleMesh.from_arrays(np.concatenate([x, away]), faces)
    fields = soft_fields(ShellSpace(two, Material()), two.vertices)
    weights = np.repeat(vertex_areas(x, ellipsoid.faces), 3)
    for part in np.split(fields, 2, axis=1):
        flat = part.reshape(len(part), -1) * weights
        assert np.abs(flat @ rigid_motions(x).T).max() < 1e-4 * np.abs(flat).max()


def test_eight_poses_come_nearer_to_unseen_poses_with_soft_modes() -> None:
    rest, poses = figure.rest(), np.random.default_rng(0).uniform(-0.3, 0.3, (KNOWN + 4, len(figure.ANGLES)))
    known, unseen = np.split(figure.pose(poses), [KNOWN])
    choice = choose_geometry(AUTO, rest, known, Material(), among=("vertices",))
    assert choice.count is not None
    assert choice.count > KNOWN - 1 > most_modes(KNOWN)
    lines = straight_lines(choice, known, rest, Material()).first(choice.count)
    components = PrincipalComponents.of(known, rest.vertices).nearest(unseen, KNOWN - 1)
    ours, theirs = (
        vertex_distances(near, unseen, rest.diagonal).mean() for near in (lines.nearest(unseen).vertices, components)
    )
    assert ours < 0.6 * theirs


def test_a_number_of_modes_that_was_asked_for_has_no_soft_modes(ellipsoid: TriangleMesh, waves: FloatArray) -> None:
    index = np.arange(KNOWN, 2 * KNOWN)
    assert held_out(ellipsoid, waves, index, None, AUTO, Material()).counts[-1] > KNOWN - 1
    found = held_out(ellipsoid, waves, index, None, ModeSettings(geometry="vertices", count=5), Material())
    assert found.counts[-1] == 5
    assert found.near["modes"][-1] == pytest.approx(found.near["remembering_components"][-1], abs=1e-6)


@pytest.mark.parametrize("kind", ["vertices", "nric", "differential"])
def test_modes_of_the_data_come_first(ellipsoid: TriangleMesh, waves: FloatArray, kind: StraightKind) -> None:
    shapes = waves[:KNOWN]
    choice = choose_geometry(ModeSettings(geometry="auto"), ellipsoid, shapes, Material(), among=(kind,))
    assert choice.soft_share > 0
    lines, plain = straight_lines(choice, shapes, ellipsoid, Material()), StraightLines.of(kind, shapes, ellipsoid)
    assert lines.spread is not None
    assert len(lines) > len(plain) == KNOWN - 1
    # The first mode of the data is among the first modes, nearly.
    roots = np.sqrt(plain.weights)
    first, basis = plain.modes[0] * roots, np.linalg.qr((lines.modes[:KNOWN] * roots).T)[0]
    assert np.linalg.norm(basis.T @ first) > 0.99 * np.linalg.norm(first)


def test_a_model_of_few_shapes_has_room_for_unseen_shapes(
    ellipsoid: TriangleMesh, waves: FloatArray, tmp_path: Path
) -> None:
    data = tmp_path / "shapes.npz"
    np.savez(data, vertices=waves[:KNOWN], faces=ellipsoid.faces)
    text = (
        f'[collection]\ndata = "{data}"\n[modes]\ngeometry = "vertices"\n'
        '[export]\ndecoder = false\nname = "waves"\ntitle = "Waves"\ndescription = "Waves."\nlicence = "MIT"\n'
    )
    run = Run(tmp_path / "run", parse(text, "waves.toml"), text, tmp_path / "models")
    assert execute(run)
    model, unseen = shapespace.load(run.bundle), waves[KNOWN:]
    assert model.dimension > KNOWN - 1
    codes = run.collection.lines.project(unseen / run.collection.scale)
    assert ((codes > model.lower) & (codes < model.upper)).mean() > 0.9
    errors = np.mean([model.encode(shape).distances.mean() for shape in unseen]) / ellipsoid.diagonal
    components = PrincipalComponents.of(waves[:KNOWN], ellipsoid.vertices).nearest(unseen, KNOWN - 1)
    assert errors < 0.95 * vertex_distances(components, unseen, ellipsoid.diagonal).mean()
    report = write_report(run.directory).read_text(encoding="utf-8")
    assert "some coordinates are soft" in report
    assert "as far as the shapes allow" in report
