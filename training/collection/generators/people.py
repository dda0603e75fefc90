"""Bodies of people by the package ``anny``: one body with moving hands, face and limbs, and several bodies in poses.

The package has 104 bones, 6 numbers for the form of a body, and 52 actions of the face. Its code is under Apache-2.0,
its meshes come from MakeHuman and are CC0. Lengths are in metres. A body stands on z = 0 and looks along −y; its left
side is at x > 0. Bones rotate by angles between the limits of human joints. Eyes and tongue are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.vectors import unit
from shapespace.training.collection.faults import Fault, IngestError
from shapespace.training.collection.mesh_collection import MeshCollection

#: Poses of `expressive`, as in the paper: with hands and faces, and with moving limbs.
HANDS_AND_FACES, LIMBS = 100, 49
#: Bodies of `people`, and poses of each.
BODIES, POSES = 24, 14
#: Vertices farther apart than the first distance at rest, and closer than the second in a pose, touch; in metres.
APART, NEAR = 0.3, 0.02
#: Share of the limits within which `people` move, so that no body touches itself.
MODERATE = 0.6

X, Y, Z = np.eye(3)

#: Least and greatest angle in radians of each degree of freedom in the middle of the body, beside the pose at rest, and
#: the bones that share it equally. Forwards and to the body's left are positive.
_MIDDLE: dict[str, tuple[tuple[float, float], FloatArray]] = {
    "spine bend": ((-0.3, 0.8), X),
    "spine lean": ((-0.4, 0.4), Y),
    "spine twist": ((-0.6, 0.6), Z),
    "head nod": ((-0.5, 0.5), X),
    "head tilt": ((-0.4, 0.4), Y),
    "head turn": ((-0.9, 0.9), Z),
}
_SPINE = ("spine05", "spine04", "spine03", "spine02", "spine01")
_NECK = ("neck01", "neck02", "neck03", "head")
#: Limits on each side. At rest arms are half lowered and elbows a little bent. Forwards, outwards, and inwards for
#: twists, are positive.
_SIDE: dict[str, tuple[float, float]] = {
    "arm swing": (-0.5, 1.2),
    "arm raise": (-0.4, 0.9),
    "arm twist": (-0.6, 0.8),
    "elbow": (-0.3, 1.5),
    "forearm twist": (-0.9, 0.9),
    "wrist bend": (-0.7, 0.8),
    "wrist side": (-0.3, 0.3),
    "leg swing": (-0.4, 1.4),
    "leg spread": (-0.1, 0.6),
    "leg twist": (-0.3, 0.3),
    "knee": (0.0, 1.8),
    "ankle": (-0.5, 0.4),
}
#: Limits of each finger, from the thumb.
_CURLS = ((-0.2, 0.6), *[(-0.2, 1.2)] * 4)
_SPREADS = ((-0.3, 0.3), (-0.15, 0.15), (-0.08, 0.08), (-0.12, 0.12), (-0.2, 0.2))

#: Actions of the face that exclude each other, without the side. Each group contributes at most one to an expression.
_FACE: tuple[tuple[str, ...], ...] = (
    ("browDown", "browInnerUp", "browOuterUp"),
    ("eyeBlink", "eyeSquint", "eyeWide"),
    ("cheekPuff", "cheekSquint"),
    ("jawOpen", "jawForward", "jawLeft", "jawRight"),
    ("mouthSmile", "mouthFrown", "mouthStretch", "mouthDimple", "mouthPress"),
    ("mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight", "mouthRollLower", "mouthRollUpper"),
    ("mouthUpperUp", "mouthLowerDown", "mouthShrugLower", "mouthShrugUpper"),
    ("noseSneer",),
)


def _limits() -> dict[str, tuple[float, float]]:
    found = {name: bounds for name, (bounds, _) in _MIDDLE.items()}
    for side in ("left", "right"):
        found |= {f"{side} {name}": bounds for name, bounds in _SIDE.items()}
        found |= {f"{side} finger {k} curl": bounds for k, bounds in enumerate(_CURLS, 1)}
        found |= {f"{side} finger {k} spread": bounds for k, bounds in enumerate(_SPREADS, 1)}
    return found


#: Least and greatest angle in radians of each degree of freedom, in order.
LIMITS = _limits()
HAND = tuple(name for name in LIMITS if "finger" in name or "wrist" in name or "forearm" in name)
LIMB = tuple(name for name in LIMITS if name not in HAND)


class AnnyBody:
    """The body model of the package ``anny``: vertices of poses, forms and expressions.

    Its first use takes most of a minute, because the package then fills its cache (``ANNY_CACHE_DIR``, by default
    ``~/.cache/anny``). Raises IngestError if the package is not installed.
    """

    def __init__(self) -> None:
        try:
            import anny
            import torch
        except ImportError as error:
            raise IngestError(
                Fault("", f"this generator needs the package {error.name}", "pip install 'shapespace[people]'")
            ) from error
        self._torch = torch
        self._model: Any = anny.Anny(facial_actions="all", skinning_method="lbs")
        self.bones: list[str] = list(self._model.bone_labels)
        self.forms: list[str] = list(self._model.phenotype_labels)
        self.actions: list[str] = list(self._model.facial_action_labels)
        faces = self._model.faces.numpy()
        self._skin, self.faces = _largest_piece(faces)
        first = self._call(np.zeros((1, len(LIMITS))), {}, {}, turns=False)
        self._floor = first["vertices"][0, self._skin, 2].min().item()
        self.rest: FloatArray = self._vertices(first)[0]
        heads = first["rest_bone_heads"][0].double().numpy()
        self._turns = _turns(self.bones, dict(zip(self.bones, heads, strict=True)))

    def _call(
        self, angles: FloatArray, forms: Mapping[str, FloatArray], face: Mapping[str, FloatArray], *, turns: bool = True
    ) -> dict[str, Any]:
        torch, n = self._torch, len(angles)
        poses = np.tile(np.eye(4), (n, len(self.bones), 1, 1))
        if turns:
            vectors = np.einsum("na,abx->nbx", angles, self._turns)
            poses[:, :, :3, :3] = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(n, -1, 3, 3)
        plain = {name: np.full(n, 0.5) for name in self.forms}
        with torch.no_grad():
            found: dict[str, Any] = self._model(
                pose_parameters=torch.from_numpy(poses),
                phenotype_kwargs={name: torch.from_numpy(values) for name, values in (plain | {**forms}).items()},
                facial_actions={name: torch.from_numpy(values) for name, values in face.items()},
            )
        return found

    def _vertices(self, found: Mapping[str, Any]) -> FloatArray:
        skin: FloatArray = found["vertices"].double().numpy()[:, self._skin]
        return skin - self._floor * Z

    def vertices(
        self,
        angles: FloatArray,
        forms: Mapping[str, FloatArray] | None = None,
        face: Mapping[str, FloatArray] | None = None,
    ) -> FloatArray:
        """Return vertices (n, V, 3) for angles (n, D) in the order of `LIMITS`, and forms and actions (n,) by name."""
        return self._vertices(self._call(angles, forms or {}, face or {}))


def _largest_piece(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the vertices of the largest connected piece, and its faces (F, 3) with indices of these vertices."""
    count = int(faces.max()) + 1
    i, j = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    _, piece = connected_components(coo_array((np.ones(len(i)), (i, j)), (count, count)), directed=False)
    kept = piece == np.bincount(piece).argmax()
    index = np.cumsum(kept) - 1
    return np.flatnonzero(kept), index[faces[kept[faces[:, 0]]]]


def _turns(bones: Sequence[str], head: Mapping[str, FloatArray]) -> FloatArray:
    """Return the rotation vector (D, B, 3) of each bone for an angle of 1 in each degree of freedom of `LIMITS`.

    Axes are those at rest, and bones that share an angle turn by equal parts. ``head`` is the joint of each bone.
    """
    turns = np.zeros((len(LIMITS), len(bones), 3))
    row, column = ({name: k for k, name in enumerate(names)} for names in (LIMITS, bones))

    def turn(name: str, axis: FloatArray, shares: Mapping[str, float]) -> None:
        for bone, share in shares.items():
            turns[row[name], column[bone]] = share * unit(axis)

    for name, (_, axis) in _MIDDLE.items():
        shared = _SPINE if name.startswith("spine") else _NECK
        turn(name, axis, dict.fromkeys(shared, 1 / len(shared)))
    for side, end, out in (("left", "L", 1), ("right", "R", -1)):

        def at(bone: str, end: str = end) -> FloatArray:
            return head[f"{bone}.{end}"]

        arm, forearm = at("lowerarm01") - at("upperarm01"), at("wrist") - at("lowerarm01")
        leg = at("foot") - at("upperleg01")
        # From the little finger to the index finger, and out of the back of the hand.
        across = at("finger2-1") - at("finger5-1")
        back = out * np.cross(at("finger3-1") - at("wrist"), across)
        shoulder = {f"clavicle.{end}": 0.1, f"shoulder01.{end}": 0.2, f"upperarm01.{end}": 0.7}
        turn(f"{side} arm swing", np.cross(arm, -Y), shoulder)
        turn(f"{side} arm raise", -out * Y, shoulder)
        turn(f"{side} arm twist", -out * arm, {f"upperarm01.{end}": 0.4, f"upperarm02.{end}": 0.6})
        turn(f"{side} elbow", np.cross(arm, forearm), {f"lowerarm01.{end}": 1.0})
        turn(f"{side} forearm twist", -out * forearm, {f"lowerarm02.{end}": 0.6, f"wrist.{end}": 0.4})
        turn(f"{side} wrist bend", np.cross(back, at("finger3-1") - at("wrist")), {f"wrist.{end}": -1.0})
        turn(f"{side} wrist side", out * back, {f"wrist.{end}": 1.0})
        turn(f"{side} leg swing", -X, {f"upperleg01.{end}": 1.0})
        turn(f"{side} leg spread", -out * Y, {f"upperleg01.{end}": 1.0})
        turn(f"{side} leg twist", -out * leg, {f"upperleg01.{end}": 0.4, f"upperleg02.{end}": 0.6})
        turn(f"{side} knee", X, {f"lowerleg01.{end}": 1.0})
        turn(f"{side} ankle", -X, {f"foot.{end}": 1.0})
        for k in range(1, 6):
            first, second, third = (at(f"finger{k}-{joint}") for joint in (1, 2, 3))
            # The thumb bends about its own axis, the other fingers about the axis of the knuckles.
            bend = np.cross(second - first, third - second) if k == 1 else np.cross(third - first, back)
            shares = {1: 0.5, 2: 1.0, 3: 1.0} if k == 1 else {1: 1.0, 2: 1.0, 3: 0.7}
            turn(f"{side} finger {k} curl", bend, {f"finger{k}-{j}.{end}": share for j, share in shares.items()})
            turn(f"{side} finger {k} spread", out * back, {f"finger{k}-1.{end}": 1.0})
    return turns


def _row(values: Mapping[str, float]) -> FloatArray:
    return np.array([values.get(name, 0.0) for name in LIMITS])


def _random_angles(names: Sequence[str], rng: np.random.Generator, share: float = 1.0) -> dict[str, float]:
    """Draw angles from triangular distributions between their limits, or a share of these, with the mode at rest."""
    lower, upper = share * np.array([LIMITS[name] for name in names]).T
    return dict(zip(names, rng.triangular(lower, np.clip(0, lower, upper), upper), strict=True))


def _hands(rng: np.random.Generator) -> dict[str, float]:
    """Draw angles of both hands: fingers curl together, and some of them stay apart from the others."""
    found = _random_angles(HAND, rng)
    for side in ("left", "right"):
        common = rng.uniform(0, 1)
        for k, (least, most) in enumerate(_CURLS, 1):
            own = rng.uniform(0, 1) if rng.uniform() < 0.3 else np.clip(common + 0.15 * rng.standard_normal(), 0, 1)
            found[f"{side} finger {k} curl"] = least + own * (most - least)
    return found


def _expression(actions: Sequence[str], rng: np.random.Generator) -> dict[str, float]:
    """Draw strengths of actions of the face: most groups contribute one, on both sides or on one."""
    found: dict[str, float] = {}
    for group in _FACE:
        action, strength, acts = group[rng.integers(len(group))], rng.uniform(0.3, 1), rng.uniform() < 0.6
        sides = [f"{action}{side}" for side in ("Left", "Right") if f"{action}{side}" in actions] or [action]
        alone = rng.uniform() < 0.25
        kept = [sides[rng.integers(len(sides))]] if alone else sides
        if acts:
            found |= dict.fromkeys(kept, strength)
    return found


def _touches(rest: FloatArray, vertices: FloatArray) -> bool:
    """Whether vertices that are far apart at rest come near to each other."""
    i, j = cKDTree(vertices).query_pairs(NEAR, output_type="ndarray").T
    return bool((np.linalg.norm(rest[i] - rest[j], axis=1) > APART).any())


def expressive_meshes(seed: int = 0) -> MeshCollection:
    """Return one body at rest, then with hands and faces, then with moving limbs: 149 shapes, as in the paper."""
    body, rng = AnnyBody(), np.random.default_rng(seed)
    names, shapes = ["rest"], [body.rest]
    for k in range(1, HANDS_AND_FACES):
        angles = _hands(rng) | _random_angles(("head nod", "head tilt", "head turn"), rng, 0.5)
        face = {name: np.array([strength]) for name, strength in _expression(body.actions, rng).items()}
        names.append(f"hands and face {k}")
        shapes.append(body.vertices(_row(angles)[None], face=face)[0])
    while len(shapes) < HANDS_AND_FACES + LIMBS:
        shape = body.vertices(_row(_random_angles(LIMB, rng))[None])[0]
        if not _touches(body.rest, shape):
            names.append(f"limbs {len(shapes) - HANDS_AND_FACES + 1}")
            shapes.append(shape)
    return MeshCollection(tuple(names), np.stack(shapes), body.faces)


def people_meshes(bodies: int = BODIES, poses: int = POSES, seed: int = 0) -> MeshCollection:
    """Return bodies of adults in the same poses, the pose at rest first. The first body has the mean form."""
    body, rng = AnnyBody(), np.random.default_rng(seed)
    forms = {name: np.append(0.5, rng.uniform(0.15, 0.85, bodies - 1)) for name in body.forms}
    forms["age"] = np.append(0.65, rng.uniform(0.55, 0.95, bodies - 1))
    rest = body.vertices(np.zeros((bodies, len(LIMITS))), forms)
    by_pose = [rest]
    while len(by_pose) < poses:
        angles = _row(_random_angles((*LIMB, *HAND), rng, MODERATE))
        shapes = body.vertices(np.tile(angles, (bodies, 1)), forms)
        if not any(map(_touches, rest, shapes)):
            by_pose.append(shapes)
    names = [f"person {k + 1}, pose {p + 1}" for k in range(bodies) for p in range(poses)]
    vertices = np.stack(by_pose, axis=1).reshape(bodies * poses, *rest.shape[1:])
    return MeshCollection(tuple(names), vertices, body.faces)
