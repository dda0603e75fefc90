"""The articulated figure: poses of the mannequin, each given by the angles of its joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.mesh.vectors import unit
from shapespace.training.collection.generators.mannequin import (
    ANKLE,
    ARM,
    EDGE,
    ELBOW,
    HIP,
    KNEE,
    LEG,
    MIRROR,
    SHOULDER,
    WRIST,
    X,
    Y,
    Z,
    rest,
)


class FigureError(ValueError):
    """Angles or a number of poses that the figure can't have."""


_SPINE = {"spine bend": (-0.35, 0.8), "spine lean": (-0.4, 0.4), "spine twist": (-0.6, 0.6)}
_HEAD = {"head nod": (-0.5, 0.6), "head tilt": (-0.4, 0.4), "head turn": (-0.9, 0.9)}
_ARM = {"arm swing": (-0.6, 1.2), "arm raise": (-0.4, 1.1), "arm twist": (-0.5, 1.2), "elbow": (0.0, 2.1)}
_LEG = {"leg swing": (-0.5, 1.3), "leg spread": (-0.1, 0.6), "knee": (0.0, 1.9)}

#: Least and greatest angle in radians of each degree of freedom, in order. Forwards, outwards, upwards, inwards and
#: to the figure's left are positive.
ANGLES: dict[str, tuple[float, float]] = {
    **_SPINE,
    **_HEAD,
    **{f"{side} {name}": bounds for side in ("left", "right") for name, bounds in {**_ARM, **_LEG}.items()},
}


@dataclass(frozen=True)
class Joint:
    """A joint of the figure: its rotation grows smoothly from zero at one plane to the full angle at another."""

    name: str  # the joint's name
    centre: FloatArray  # (3,) fixed point of the rotation
    start: tuple[FloatArray, FloatArray]  # point and normal of the plane where the motion begins
    end: tuple[FloatArray, FloatArray]  # point and normal of the plane beyond which the motion is rigid
    tip: FloatArray  # (3,) near the end of the limb. Beyond the first plane, the connected piece with the tip moves.
    axes: Mapping[str, FloatArray]  # (3,) axis of rotation at each degree of freedom; they add as rotation vectors
    # With 0, points between the planes turn by a part of the angle, which keeps their distance from the centre. With 1,
    # they move a part of the way to their place after the full rotation, which rounds hips and armpits off. Values in
    # between mix both.
    softness: float = 0.0
    # Joints whose moving points also move with this joint, even outside its planes.
    carries: Sequence[str] = field(default=())

    def shares(self, mesh: TriangleMesh) -> FloatArray:
        """Return the share (V,) of the joint's motion for each vertex, between 0 and 1."""
        v = mesh.vertices
        (p, n), (q, m) = self.start, self.end
        begun, missing = np.maximum((v - p) @ n, 0), np.maximum((q - v) @ m, 0)
        i, j = mesh.edges[(begun[mesh.edges] > 0).all(axis=1)].T
        _, piece = connected_components(coo_array((np.ones(len(i)), (i, j)), (len(v), len(v))), directed=False)
        with_tip = piece == piece[np.linalg.norm(v - self.tip, axis=1).argmin()]
        t = np.divide(begun, begun + missing, out=np.zeros(len(v)), where=with_tip & (begun > 0))
        return t * t * (3 - 2 * t)

    def mirrored(self) -> Joint:
        """Return the same joint on the right side of the figure."""
        (p, n), (q, m) = self.start, self.end
        return replace(
            self,
            name=self.name.replace("left", "right"),
            centre=MIRROR * self.centre,
            start=(MIRROR * p, MIRROR * n),
            end=(MIRROR * q, MIRROR * m),
            tip=MIRROR * self.tip,
            axes={name.replace("left", "right"): -MIRROR * axis for name, axis in self.axes.items()},
        )


def _joint(
    name: str,
    point: FloatArray,
    shift: FloatArray,
    start: tuple[float, FloatArray],
    end: tuple[float, FloatArray],
    tip: FloatArray,
    axes: dict[str, FloatArray],
    softness: float = 0.0,
) -> Joint:
    """Make a joint at a point, with its centre shifted from there.

    Each plane is given by its distance from the point and a normal of any length.
    """
    planes = [(point + distance * unit(normal), unit(normal)) for distance, normal in (start, end)]
    carries = ("left shoulder", "right shoulder") if axes.keys() == _SPINE.keys() else ()
    return Joint(name, point + shift, planes[0], planes[1], tip, axes, softness, carries)


def _joints() -> tuple[Joint, ...]:
    hand, head = WRIST + 0.17 * ARM, 1.7 * Y
    flexion, chin, nape, lat = np.cross(ARM, Z), Y + 0.35 * Z, Y + 0.2 * Z, 0.97 * X + 0.24 * Y
    groin = 0.76 * X - 0.65 * Y
    spine = dict(zip(_SPINE, (X / 2, -Z / 2, Y / 2), strict=True))
    neck = dict(zip(_HEAD, (X / 2, -Z / 2, Y / 2), strict=True))
    twist, shoulder = {"left arm twist": -ARM}, {"left arm swing": flexion, "left arm raise": Z}
    hip = {"left leg swing": -X, "left leg spread": Z}
    # Centres lie towards the crease, where the surface then folds less.
    left = (
        _joint("left elbow", ELBOW, 0.012 * Z, (-0.06, ARM), (0.06, ARM), hand, {"left elbow": flexion}),
        _joint("left upper arm", SHOULDER, 0 * Z, (0.02, lat), (0.24, ARM), hand, twist),
        _joint("left shoulder", SHOULDER, 0.01 * (Y + Z), (-0.045, lat), (0.11, ARM + X), hand, shoulder, 0.7),
        _joint("left knee", KNEE, -0.012 * Z, (-0.08, LEG), (0.08, LEG), ANKLE, {"left knee": np.cross(Z, LEG)}),
        _joint("left hip", HIP, 0.035 * Z, (0.002, groin), (0.19, LEG), ANKLE, hip, 0.7),
    )
    return (
        *left,
        *(joint.mirrored() for joint in left),
        _joint("skull", 1.50 * Y, 0.03 * Y, (-0.045, chin), (0.022, chin), head, neck),
        _joint("neck", 1.48 * Y, -0.02 * (Y + Z), (-0.05, nape), (0.06, nape), head, neck),
        _joint("chest", 1.18 * Y, -0.02 * Z, (-0.11, Y), (0.11, Y), head, spine),
        _joint("waist", 1.03 * Y, -0.02 * Z, (-0.09, Y), (0.11, Y), head, spine),
    )


#: The joints, from the tips of the limbs to the root. The root is the pelvis, which never moves.
JOINTS = _joints()


@cache
def _shares() -> dict[str, FloatArray]:
    """Return the share (V,) of each joint's motion, by the joint's name."""
    shares: dict[str, FloatArray] = {}
    for joint in JOINTS:
        shares[joint.name] = np.max([joint.shares(rest()), *(shares[name] for name in joint.carries)], axis=0)
    return shares


def _turn(x: FloatArray, omega: FloatArray) -> FloatArray:
    """Return displacements of points (…, 3) by rotation vectors (…, 3): Rodrigues' formula less the identity."""
    t = np.linalg.norm(omega, axis=-1, keepdims=True)
    across = np.cross(omega, x)
    return np.sinc(t / np.pi) * across + 0.5 * np.sinc(t / (2 * np.pi)) ** 2 * np.cross(omega, across)


def pose(angles: ArrayLike) -> FloatArray:
    """Return vertices (n, V, 3) for angles (n, D) in radians, in the order of `ANGLES`.

    Raises:
        FigureError: the angles have another shape or are not finite.
    """
    angles = np.asarray(angles, dtype=np.float64)
    if angles.ndim != 2 or angles.shape[1] != len(ANGLES):
        raise FigureError(f"angles must be (n, {len(ANGLES)}), not {angles.shape}")
    if not np.isfinite(angles).all():
        raise FigureError("an angle is not finite")
    vertices = np.repeat(rest().vertices[None], len(angles), axis=0)
    names = list(ANGLES)
    for joint in JOINTS:
        share = _shares()[joint.name]
        moved = share > 0
        w, k = share[moved, None], joint.softness
        omega = (angles[:, [names.index(name) for name in joint.axes]] @ np.stack(list(joint.axes.values())))[:, None]
        x = vertices[:, moved] - joint.centre
        vertices[:, moved] += (1 - k) * _turn(x, w * omega) + k * w * _turn(x, omega)
    return vertices


#: Poses with a name, each given by its nonzero angles in radians.
NAMED: dict[str, dict[str, float]] = {
    "rest": {},
    "walking": {
        "left leg swing": 0.5, "left knee": 0.15, "right leg swing": -0.35, "right knee": 0.45, "spine twist": 0.1,
        "left arm swing": -0.35, "left arm raise": -0.35, "left elbow": 0.3,
        "right arm swing": 0.4, "right arm raise": -0.35, "right elbow": 0.5,
    },
    "sitting": {
        "left leg swing": 1.3, "right leg swing": 1.3, "left knee": 1.4, "right knee": 1.4,
        "left arm raise": -0.35, "right arm raise": -0.35, "left arm swing": 0.3, "right arm swing": 0.3,
        "left elbow": 0.7, "right elbow": 0.7,
    },
    "waving": {
        "right arm raise": 0.8, "right elbow": 1.3, "right arm twist": 1.2, "left arm raise": -0.35,
        "head tilt": 0.15, "spine lean": 0.08,
    },
    "reaching": {"left arm raise": 1.1, "right arm raise": 1.1, "spine bend": -0.25, "head nod": -0.4},
    "bowing": {
        "spine bend": 0.75, "head nod": 0.3, "left arm raise": -0.35, "right arm raise": -0.35,
        "left leg swing": 0.25, "right leg swing": 0.25,
    },
    "lunging": {
        "left leg swing": 1.1, "left knee": 1.2, "right leg swing": -0.45, "right knee": 0.3,
        "left arm raise": 0.6, "right arm raise": 0.6,
    },
}  # fmt: skip


def _touches(vertices: FloatArray) -> bool:
    """Whether vertices more than 0.25 m apart at rest are closer to each other than an edge is long."""
    i, j = cKDTree(vertices).query_pairs(EDGE, output_type="ndarray").T
    far = np.linalg.norm(rest().vertices[i] - rest().vertices[j], axis=1) > 0.25
    return bool(far.any())


def poses(count: int = 60, seed: int = 0) -> tuple[list[str], FloatArray, IntArray]:
    """Return the collection: names (n), vertices (n, V, 3) and faces (F, 3).

    The named poses come first, beginning with the rest pose; then random poses in which no limb touches another. Random
    angles have a triangular distribution between their bounds with its mode at rest.

    Raises:
        FigureError: the count n is below 1.
    """
    if count < 1:
        raise FigureError(f"count must be at least 1, not {count}")
    names = list(NAMED)[:count]
    shapes = list(pose([[NAMED[name].get(angle, 0.0) for angle in ANGLES] for name in names]))
    rng = np.random.default_rng(seed)
    lower, upper = np.array(list(ANGLES.values())).T
    while len(shapes) < count:
        shape = pose(rng.triangular(lower, 0, upper)[None])[0]
        if not _touches(shape):
            names.append(f"random {len(shapes) - len(NAMED) + 1}")
            shapes.append(shape)
    return names, np.stack(shapes), rest().faces
