"""Poses of people, with a stand-in for the package ``anny``, which takes 400 MB: tests/long/test_people.py has it."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from shapespace.training.collection.faults import IngestError
from shapespace.training.collection.generators import MESHES, people
from shapespace.training.collection.mesh_collection import MeshCollection

MIDDLE = [*(f"spine0{k}" for k in range(1, 6)), "neck01", "neck02", "neck03", "head"]
ARM = ["clavicle", "shoulder01", "upperarm01", "upperarm02", "lowerarm01", "lowerarm02", "wrist"]
LEG = ["upperleg01", "upperleg02", "lowerleg01", "foot"]
SIDE = [*ARM, *LEG, *(f"finger{k}-{j}" for k in range(1, 6) for j in range(1, 4))]
BONES = [*MIDDLE, *(f"{name}.{end}" for end in "LR" for name in SIDE)]


def head_of(bone: str) -> np.ndarray:
    """Place of a joint: a rough body with fingers."""
    name, _, end = bone.partition(".")
    if name in MIDDLE:
        return np.array([0, 0, 1 + 0.06 * MIDDLE.index(name)])
    if name.startswith("finger"):
        k, j = int(name[6]), int(name[8])
        place = np.array([0.72 + 0.02 * j, -0.2 + 0.02 * k, 1.1 - 0.01 * j**2 - 0.003 * k])
    else:
        at = SIDE.index(name)
        arm, leg = (0.1 + 0.1 * at, -0.02 * at**1.5, 1.4 - 0.03 * at), (0.1, 0.02 * (at % 2), 1.7 - 0.15 * at)
        place = np.array(arm if at < 7 else leg)
    return place * [-1 if end == "R" else 1, 1, 1]


class BallsOnBones:
    """A body of one ball, with a vertex for each bone, and a small piece as the package's eyes are."""

    def __init__(self, **options: Any) -> None:
        assert options == {"facial_actions": "all", "skinning_method": "lbs"}
        ball, eye = trimesh.creation.icosphere(subdivisions=2), trimesh.creation.icosphere(subdivisions=0)
        self.bone_labels, self.phenotype_labels = BONES, ["age", "height"]
        names = {name for group in people._FACE for name in group}
        self.facial_action_labels = [f"{name}{side}" for name in sorted(names) for side in ("Left", "Right")]
        self.faces = torch.from_numpy(np.concatenate([eye.faces, len(eye.vertices) + ball.faces]))
        self.heads = np.array([head_of(bone) for bone in BONES])
        self.points, self.eye = ball.vertices, len(eye.vertices)
        self.poses: list[np.ndarray] = []

    def __call__(self, *, pose_parameters: Any, phenotype_kwargs: Any, facial_actions: Any) -> dict[str, Any]:
        turns = pose_parameters[:, :, :3, :3].numpy()
        self.poses.extend(turns)
        body = np.tile(self.points + np.array([0, 0, 1]), (len(turns), 1, 1))
        of_bones = turns @ [0.1, 0.2, 0.3] + self.heads
        body[:, : len(BONES)] += of_bones
        body[:, -1] += sum(values.numpy()[:, None] for values in facial_actions.values())
        body *= 0.5 + phenotype_kwargs["height"].numpy()[:, None, None]
        vertices = np.concatenate([np.zeros((len(turns), self.eye, 3)), body], axis=1)
        heads = np.tile(self.heads, (len(turns), 1, 1))
        return {"vertices": torch.from_numpy(vertices), "rest_bone_heads": torch.from_numpy(heads)}


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[BallsOnBones]:
    """The bodies that the generators make."""
    bodies: list[BallsOnBones] = []
    stand_in = ModuleType("anny")
    monkeypatch.setitem(sys.modules, "anny", stand_in)
    monkeypatch.setattr(people, "_touches", lambda rest, shape: False)

    def anny(**options: Any) -> BallsOnBones:
        bodies.append(BallsOnBones(**options))
        return bodies[-1]

    vars(stand_in)["Anny"] = anny
    return bodies


def moved(meshes: MeshCollection, shape: int) -> set[str]:
    """Bones of the vertices that move in a shape, from rest; ``face`` for the face's vertex."""
    away = np.linalg.norm(meshes.vertices[shape] - meshes.vertices[0], axis=1) > 1e-9
    return {BONES[k] for k in np.flatnonzero(away[: len(BONES)])} | ({"face"} if away[-1] else set())


def test_one_body_moves_hands_and_face_and_then_limbs(made: list[BallsOnBones]) -> None:
    meshes = MESHES["expressive"]()
    assert len(meshes.names) == len(set(meshes.names)) == len(meshes.vertices) == 149
    assert meshes.vertices.shape[1] == len(made[0].points), "the small piece is left out"
    assert len(np.unique(meshes.faces)) == meshes.vertices.shape[1]
    assert abs(meshes.vertices[0][:, 2].min()) < 1e-9
    hands = [moved(meshes, k) for k in range(1, 100)]
    limbs = [moved(meshes, k) for k in range(100, 149)]
    assert set.union(*hands) - {"face"} == {b for b in BONES if "finger" in b or b.split(".")[0] in
                                            ("lowerarm02", "wrist", "neck01", "neck02", "neck03", "head")}  # fmt: skip
    assert sum("face" in bones for bones in hands) > 90
    assert not any("finger" in bone for bones in limbs for bone in bones)
    assert {"upperleg01.L", "lowerleg01.R", "upperarm01.L", "spine03", "foot.R"} < set.intersection(*limbs)


def test_people_take_the_same_poses_in_their_own_forms(made: list[BallsOnBones]) -> None:
    meshes = MESHES["people"]()
    assert len(meshes.names) == len(set(meshes.names)) == len(meshes.vertices) == 24 * 14
    heights = np.ptp(meshes.vertices[..., 2], axis=1).reshape(24, 14)
    assert len(np.unique(heights[:, 0].round(9))) == 24
    by_pose = np.reshape(made[0].poses[1:], (14, 24, -1))
    assert (by_pose == by_pose[:, :1]).all()
    assert len(np.unique(by_pose[:, 0].round(9), axis=0)) == 14


def test_the_same_seed_gives_the_same_shapes_and_another_seed_others(made: list[BallsOnBones]) -> None:
    first, again, other = (people.people_meshes(3, 4, seed) for seed in (0, 0, 1))
    assert (first.vertices == again.vertices).all()
    assert np.abs(first.vertices - other.vertices).max() > 0.01


def test_no_joint_turns_further_than_its_limits(made: list[BallsOnBones]) -> None:
    MESHES["expressive"]()
    turned = Rotation.from_matrix(np.reshape(made[0].poses, (-1, 3, 3))).magnitude().reshape(-1, len(BONES)).max(axis=0)
    by_bone = dict(zip(BONES, turned, strict=True))
    assert 1.2 < by_bone["lowerleg01.L"] <= 1.8
    assert 1.0 < by_bone["lowerarm01.R"] <= 1.5
    assert by_bone["head"] <= np.sqrt(0.9**2 + 0.5**2 + 0.4**2) / 4
    assert all(by_bone[f"finger{k}-2.L"] <= 1.2 + 1e-9 for k in range(1, 6))


def test_limbs_that_touch_are_noticed() -> None:
    rest = np.array([[0.0, 0, 0], [0, 0, 0.01], [0, 0, 1]])
    assert not people._touches(rest, rest)
    assert people._touches(rest, rest * [1, 1, 0.005])


@pytest.mark.parametrize("generator", ["expressive", "people"])
def test_a_missing_package_is_named_with_the_command(generator: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(IngestError) as caught:
        MESHES[generator]()
    assert str(caught.value) == "this generator needs the package anny; pip install 'shapespace[people]'"
