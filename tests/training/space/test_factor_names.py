"""Names of factors: the part that they change, and the kind of motion."""

from collections.abc import Sequence

import numpy as np
import pytest
import trimesh

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.collection.generators import figure
from shapespace.training.space.factor_names import names

#: Height of a joint.
JOINT = np.array([0, 0.65, 0])


def body(*radii: float) -> TriangleMesh:
    """Return a ball with three radii."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    return TriangleMesh.from_arrays(ball.vertices * radii, ball.faces)


def named(mesh: TriangleMesh, fields: Sequence[FloatArray], groups: Sequence[Sequence[int]] | None = None) -> list[str]:
    """Name the factors of vertex fields (V, 3), by default one for each field."""
    jacobian = NRICJacobian(mesh.connectivity)(mesh.vertices)
    nric = np.array([jacobian @ field.ravel() for field in fields])
    groups = [[k] for k in range(len(fields))] if groups is None else groups
    return names(groups, nric, np.array(fields), WeightedNorm.of(mesh, 1e-2), mesh)


def near(mesh: TriangleMesh, *place: float) -> FloatArray:
    """Return a bump (V, 1) around a place."""
    return np.exp(-((mesh.vertices - place) ** 2).sum(axis=1, keepdims=True) / 0.05)


def test_a_name_says_how_a_part_moves() -> None:
    tube = body(0.5, 2, 0.5)
    v = tube.vertices
    x, y, z = v.T
    o = np.zeros(len(v))
    above = np.clip((y - 0.5) / 0.3, 0, 1)[:, None]
    fields = {
        "upper bends": above * np.cross([1, 0, 0], v - JOINT),
        "upper lengthens": above * (v - JOINT) * [0, 1, 0],
        "upper widens": above * v * [1, 0, 1],
        "upper front bulges": near(tube, 0, 0.6, 0.5) * [0, 0, 1],
        "bends": np.stack([y**2 / 2, -x * y, o], axis=1),
        "turns": np.stack([z * y, o, -x * y], axis=1),
        "whole shape lengthens": v * [0, 1, 0],
        "whole shape widens": v * [1, 0, 1],
        "whole shape grows": v,
    }
    for name, field in fields.items():
        (found,) = named(tube, [field])
        assert found.split(" ")[-1] == name.split(" ")[-1], name
        assert found == name or " " not in name, found


def test_every_joint_of_the_figure_has_its_place_and_motion() -> None:
    rest, angles = figure.rest(), list(figure.ANGLES)
    found = dict(zip(angles, named(rest, figure.pose(1e-3 * np.eye(len(angles))) - rest.vertices), strict=True))
    assert len({*found.values()}) == len(angles)
    for angle, name in found.items():
        turns = "turns" in name
        assert turns == (angle.split(" ")[-1] in ("twist", "turn")), angle
        # The figure faces the viewer, so its left is on the right.
        if angle.startswith(("left", "right")):
            assert ("right" in name) == angle.startswith("left")
        assert ("lower" in name) == ("leg" in angle or "knee" in angle)
        if angle.endswith(("elbow", "knee")):
            assert name.startswith("outer")
    limbs = ["left elbow", "right elbow", "left knee", "right knee", "left leg swing", "left arm swing", "spine twist"]
    assert not any(found[angle][-1].isdigit() for angle in limbs)


def test_places_of_one_name_are_told_apart() -> None:
    flat = body(3, 1, 0.5)  # thin along z, which gives no words
    places = ((0, 1, 0), (0, -1, 0), (-2.5, 0.5, 0), (2.9, 0, 0), (0, 0, 0.5))
    found = named(flat, [near(flat, *place) * [0, 1, 0] for place in places])
    assert [name.rsplit(" ", 1)[0] for name in found] == ["upper", "lower", "upper left", "right", "middle"]
    ends = [near(flat, x, 0, np.sqrt(9 - x * x) / 6) * [0, 1, 0] for x in (1.8, 2.8, 2.8)]
    inner, outer, again = named(flat, ends)
    assert inner.split()[0] == "inner"
    assert outer.split()[0] == "outer"
    assert again == f"{outer} 2", "the same part cannot be told apart by its place"


def test_a_relative_place_may_be_the_name_of_other_factors() -> None:
    flat = body(3, 1, 0.5)
    right, upper = ((2.9, 0.2, 0), (2.9, -0.2, 0)), ((2, 0.8, 0), (1.2, 0.95, 0))
    alone = [named(flat, [near(flat, *place) * [0, 1, 0]]) for place in (*right, *upper)]
    assert alone == [["right bends"]] * 2 + [["upper right bends"]] * 2
    found = named(flat, [near(flat, *place) * [0, 1, 0] for place in (*right, *upper)])
    assert found == ["upper right bends", "lower right bends", "upper right bends 2", "upper right bends 3"]


def test_the_strongest_mode_says_how_and_all_modes_say_where() -> None:
    rest, angles = figure.rest(), list(figure.ANGLES)
    fields = figure.pose(1e-3 * np.eye(len(angles))) - rest.vertices
    twist, swing, elbow = (angles.index(name) for name in ("left arm twist", "left arm swing", "left elbow"))
    assert named(rest, fields, [[twist, elbow]]) == ["upper right turns"]
    assert named(rest, fields, [[swing, twist]]) == ["upper right bends"]


@pytest.mark.parametrize("degenerate", [np.zeros((642, 3)), np.ones((642, 3))])
def test_a_field_without_motion_has_a_name_too(degenerate: FloatArray) -> None:
    tube = body(0.5, 2, 0.5)
    squares = np.ones((1, 2 * len(tube.edges)))
    assert names([[0]], squares, degenerate[None], WeightedNorm.of(tube, 1e-2), tube)
