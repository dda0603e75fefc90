"""Local fields: modes that the shapes of a collection have in single regions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import shapespace
from shapespace.arrays import FloatArray
from shapespace.mesh.coarsening import coarsen
from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.shell.energy import Material
from shapespace.training.collection.generators import figure
from shapespace.training.report.page import write_report
from shapespace.training.runs.config import parse
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space import geometry
from shapespace.training.space.codes import box_of, nearest_codes
from shapespace.training.space.face_coordinates import FaceCoordinates
from shapespace.training.space.generalisation import (
    ModesOfOthers,
    PrincipalComponents,
    space_of,
    vertex_distances,
)
from shapespace.training.space.geometry import choose_geometry, straight_lines
from shapespace.training.space.held_out import held_out
from shapespace.training.space.local_fields import WIDTH, local_fields, scale_of, windows
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.related import Related
from shapespace.training.space.straight_lines import StraightKind, StraightLines
from shapespace.training.stages.run import execute
from shapespace.training.stages.stage import Run

AUTO = ModeSettings(geometry="auto")
KNOWN = 8


@pytest.fixture(scope="module")
def waves(ellipsoid: TriangleMesh) -> FloatArray:
    """Eight shapes and eight others (n, V, 3), each moved by long waves of its own."""
    rng, x = np.random.default_rng(3), ellipsoid.vertices
    moved = [np.sin(0.5 * x @ rng.standard_normal((3, 3)) + rng.uniform(0, 6, 3)) for _ in range(2 * KNOWN)]
    return x + 0.08 * np.stack(moved)


def test_windows_cover_the_surface_once(ellipsoid: TriangleMesh) -> None:
    found = windows(ellipsoid)
    assert len(found) > 4
    assert (found**2).sum(axis=0) == pytest.approx(np.ones(len(ellipsoid.faces)))
    centres = ellipsoid.vertices[ellipsoid.faces].mean(axis=1)
    for window in found:
        away = np.linalg.norm(centres - centres[window.argmax()], axis=1)
        assert window[away > 4 * WIDTH * ellipsoid.diagonal].max(initial=0) < 0.01


def test_separate_parts_share_the_windows_of_their_neighbours(ellipsoid: TriangleMesh) -> None:
    x = ellipsoid.vertices
    inside = TriangleMesh.from_arrays(
        np.concatenate([x, 0.01 * x + x[0]]), np.concatenate([ellipsoid.faces, ellipsoid.faces + len(x)])
    )
    assert (windows(inside)[:, : len(ellipsoid.faces)].max(axis=1) > 0.3).all(), "no window for the small part alone"


def test_a_window_on_everything_keeps_the_field(ellipsoid: TriangleMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapespace.training.space.local_fields.WIDTH", 1e3)
    x = ellipsoid.vertices
    field = without_rigid_motion(np.sin(3 * x), x)
    assert local_fields(ellipsoid, field[None])[0, 0] == pytest.approx(field, abs=1e-6)


def test_a_local_field_turns_and_stretches_its_region_alone() -> None:
    rest = figure.rest()
    pose = figure.pose(np.full((1, len(figure.ANGLES)), 0.1)) - rest.vertices
    found = FaceCoordinates(rest).along(local_fields(rest, pose)[0])
    amounts = (found.reshape(*windows(rest).shape, -1)[..., 3:] ** 2).sum(axis=2)
    assert (windows(rest) < 0.01).mean() > 0.3
    for window, stretched in zip(windows(rest), amounts * face_areas(rest.vertices, rest.faces), strict=True):
        outside = window < 0.01
        assert stretched[outside].sum() < 0.02 * stretched.sum()


def test_eight_poses_come_nearer_to_unseen_poses_with_local_fields() -> None:
    rest, poses = figure.rest(), np.random.default_rng(0).uniform(-0.3, 0.3, (KNOWN + 4, len(figure.ANGLES)))
    known, unseen = np.split(figure.pose(poses), [KNOWN])
    choice = choose_geometry(AUTO, rest, known, Material(), among=("vertices",))
    assert choice.count is not None
    assert choice.count > KNOWN - 1 > Related.none(KNOWN).most_modes
    lines = straight_lines(choice, known, rest).first(choice.count)
    components = PrincipalComponents.of(known, rest.vertices).nearest(unseen, KNOWN - 1)
    ours, theirs = (
        vertex_distances(near, unseen, rest.diagonal).mean() for near in (lines.nearest(unseen).vertices, components)
    )
    assert ours < 0.6 * theirs


def test_no_more_modes_than_asked_for_or_than_shapes(ellipsoid: TriangleMesh, waves: FloatArray) -> None:
    index = np.arange(KNOWN, 2 * KNOWN)
    assert held_out(ellipsoid, waves, index, None, AUTO, Material()).counts[-1] > KNOWN - 1
    asked = ModeSettings(geometry="vertices", count=KNOWN + 5)
    assert held_out(ellipsoid, waves, index, None, asked, Material()).counts[-1] == KNOWN - 1


@pytest.fixture(scope="module")
def limbs() -> tuple[TriangleMesh, FloatArray]:
    """Limbs that move by themselves, in 32 poses (n, V, 3): a few show how they move, but not in all combinations."""
    return _limbs(32)


def _limbs(count: int) -> tuple[TriangleMesh, FloatArray]:
    poses = figure.pose(np.random.default_rng(0).uniform(-0.6, 0.6, (count, len(figure.ANGLES))))
    coarse = coarsen(figure.rest(), 400, poses[:4])
    rest = TriangleMesh.from_arrays(figure.rest().vertices[coarse.fine_index], coarse.faces)
    return rest, poses[:, coarse.fine_index]


def test_three_shapes_have_local_fields(limbs: tuple[TriangleMesh, FloatArray]) -> None:
    rest, poses = limbs
    known, unseen = poses[:3], poses[3:]
    choice = choose_geometry(ModeSettings(geometry="differential"), rest, known, Material())
    ours = straight_lines(choice, known, rest).first(choice.count or 0)
    plain = StraightLines.of("differential", known, rest, norm="vertices")
    assert len(ours) > len(plain) == 2
    errors = [vertex_distances(each.nearest(unseen).vertices, unseen, rest.diagonal).mean() for each in (ours, plain)]
    assert errors[0] < 0.8 * errors[1]


def test_local_fields_come_where_they_help(limbs: tuple[TriangleMesh, FloatArray]) -> None:
    rest, poses = limbs
    known, unseen = np.split(poses, [20])
    twelve = ModeSettings(geometry="differential", count=12)
    choice = choose_geometry(twelve, rest, known, Material())
    plain = choose_geometry(twelve, rest, known, Material(), vary=False)
    assert choice.local_share > 0
    assert plain.local_share == 0
    ours, without = (
        vertex_distances(
            straight_lines(each, known, rest).first(12).nearest(unseen).vertices, unseen, rest.diagonal
        ).mean()
        for each in (choice, plain)
    )
    assert ours < 0.9 * without
    assert 0.02 < choice.local_gain < 1
    # Here each shape is a sum of three fields, which move the whole surface.
    x = rest.vertices
    codes = np.random.default_rng(1).uniform(-0.05, 0.05, (20, 3))
    global_ = x + np.einsum("nk,kvj->nvj", codes, np.stack([np.sin(x * k) for k in (1, 2, 3)]))
    assert choose_geometry(ModeSettings(geometry="vertices", count=3), rest, global_, Material()).local_share == 0


def test_exponentials_take_local_fields_without_a_search(
    limbs: tuple[TriangleMesh, FloatArray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What modes leave of held-out logarithms chooses the share, and unseen exponentials come nearer too."""
    rest, poses = limbs
    known, unseen = poses[:14], poses[14:18]
    with monkeypatch.context() as patched:
        patched.setattr(geometry, "nearest_exponentials", lambda *_: pytest.fail("a search"))
        auto = ModeSettings(geometry="auto", count=10)
        choice = choose_geometry(auto, rest, known, Material(), among=("exponential",))
    assert choice.local_share > 0
    assert 0.02 < choice.local_gain < 1
    space, mean, fields = space_of(rest, known, Material(), choice.light_steps, "centred")
    motions = fields - fields.mean(axis=0)
    local = local_fields(space.reference, motions)
    local *= scale_of(local, motions, choice.local_share)
    towards = logarithms(space, mean, unseen, choice.light_steps).fields

    def error(local: FloatArray | None) -> float:
        modes = ModesOfOthers.of(space, mean, fields, 10, local)
        start = modes.codes(towards)
        near = nearest_codes(space, mean, modes.vertices, unseen, start, choice.light_steps, centre=modes.centre)
        return float(vertex_distances(near.vertices, unseen, rest.diagonal).mean())

    assert error(local) < 0.95 * error(None)


def test_local_fields_bring_further_modes() -> None:
    rest, poses = _limbs(48)
    known, unseen = np.split(poses, [36])
    auto = ModeSettings(geometry="differential")
    choices = [choose_geometry(auto, rest, known, Material(), vary=vary) for vary in (True, False)]
    ours, plain = (straight_lines(each, known, rest).first(each.count or 0) for each in choices)
    assert len(plain) < len(ours) < len(known)
    errors = [vertex_distances(each.nearest(unseen).vertices, unseen, rest.diagonal).mean() for each in (ours, plain)]
    assert errors[0] < 0.8 * errors[1]
    asked = ModeSettings(geometry="differential", count=24)
    assert choose_geometry(asked, rest, known, Material()).count == 24


def test_many_modes_take_a_small_share_of_local_fields(limbs: tuple[TriangleMesh, FloatArray]) -> None:
    """Sizes vary much more than limbs, so the weak modes have little variance. As much from local fields is enough."""
    rest, poses = limbs
    sizes = np.exp(np.random.default_rng(1).uniform(-0.5, 0.5, len(poses)))[:, None, None]
    known, unseen = np.split(sizes * (rest.vertices + 0.05 * (poses - rest.vertices)), [20])
    choice = choose_geometry(ModeSettings(geometry="vertices", count=13), rest, known, Material())
    assert 0 < choice.local_share < 0.01
    assert choice.local_gain > 0.02

    def error(share: float) -> float:
        lines = straight_lines(replace(choice, local_share=share), known, rest).first(13)
        return float(vertex_distances(lines.nearest(unseen).vertices, unseen, rest.diagonal).mean())

    assert error(choice.local_share) < min(0.97 * error(0.0), error(0.01))


@pytest.mark.parametrize("kind", ["vertices", "nric", "differential"])
def test_modes_of_the_data_come_first(ellipsoid: TriangleMesh, waves: FloatArray, kind: StraightKind) -> None:
    shapes = waves[:KNOWN]
    choice = choose_geometry(ModeSettings(geometry="auto"), ellipsoid, shapes, Material(), among=(kind,))
    assert choice.local_share > 0
    lines, plain = straight_lines(choice, shapes, ellipsoid), StraightLines.of(kind, shapes, ellipsoid, norm="vertices")
    assert lines.spread is not None
    assert len(lines) > len(plain) == KNOWN - 1
    # The first mode of the data is among the first modes, nearly.
    first, basis = plain.weighted(plain.modes[:1])[0], np.linalg.qr(plain.weighted(lines.modes[:KNOWN]).T)[0]
    assert np.linalg.norm(basis.T @ first) > 0.99 * np.linalg.norm(first)


def test_bounds_have_room_for_unseen_shapes(ellipsoid: TriangleMesh, waves: FloatArray) -> None:
    choice = choose_geometry(AUTO, ellipsoid, waves[:KNOWN], Material(), among=("vertices",))
    lines = straight_lines(choice, waves[:KNOWN], ellipsoid).first(choice.count or 0)
    assert lines.spread is not None
    assert choice.local is not None
    room = choice.local.room(lines.spread)
    lower, upper = box_of(np.concatenate([lines.coefficients, [-room, room]]))
    codes = lines.project(waves[KNOWN:])
    assert ((codes > lower) & (codes < upper)).mean() > 0.9


def test_a_model_of_few_shapes_has_room_for_unseen_shapes(tmp_path: Path) -> None:
    rest, rng = figure.rest(), np.random.default_rng(0)
    known, unseen = np.split(figure.pose(rng.uniform(-0.3, 0.3, (KNOWN + 4, len(figure.ANGLES)))), [KNOWN])
    data = tmp_path / "shapes.npz"
    np.savez(data, vertices=known, faces=rest.faces)
    text = (
        f'[collection]\ndata = "{data}"\ncoarse_vertices = 300\n[modes]\ngeometry = "differential"\n'
        '[export]\ndecoder = false\nname = "waves"\ntitle = "Waves"\ndescription = "Waves."\nlicence = "MIT"\n'
    )
    run = Run(tmp_path / "run", parse(text, "waves.toml"), text, tmp_path / "models")
    assert execute(run)
    model = shapespace.load(run.bundle)
    assert model.dimension > KNOWN - 1
    found = [model.encode(shape) for shape in unseen]
    codes, own = np.stack([each.code for each in found]), run.directory.modes.read()["coefficients"]
    room = [((codes > low) & (codes < high)).mean() for low, high in ((model.lower, model.upper), box_of(own))]
    assert room[0] > 0.7 > 0.5 > room[1]
    errors = np.mean([each.distances.mean() for each in found]) / rest.diagonal
    components = PrincipalComponents.of(known, rest.vertices).nearest(unseen, KNOWN - 1)
    assert errors < 0.6 * vertex_distances(components, unseen, rest.diagonal).mean()
    report = write_report(run.directory).read_text(encoding="utf-8")
    assert "move single regions" in report
    assert "as far as the shapes allow" in report
