"""Names of factors, by the part that they change and the kind of motion: "upper left bends"."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh, face_normals
from shapespace.training.space.modes import edge_magnitudes

#: An axis gives no names if the mesh's standard deviation along it is below this share of the largest one.
THIN = 0.2
#: A part lies to one side if its distance from the centre exceeds this share of the mesh's standard deviation.
ASIDE = 0.5
#: A part narrower than its distance from the centre lies to one side from this smaller share.
CLEARLY = 0.15
#: Two parts are told apart by their places if these differ by more than this share of the mesh's standard deviation.
APART = 0.1
#: A factor changes the whole shape if this share of the surface carries `CARRIED` of its squares.
WHOLE, CARRIED = 0.3, 0.8
#: A motion is a stretch if one strain explains this share of the squares, and strain is this multiple of rotation.
EVEN, STRAINED = 0.6, 0.8
#: A motion is a rotation if one axis explains this share of the squares.
ONE_AXIS = 0.7
#: Two directions are alike if the cosine of their angle exceeds this.
ALIKE = 0.7
#: A part grows if its strain in every direction exceeds this share of the largest strain.
ALL_ROUND = 0.4
#: Words for the sides of the axes y, x, z, the most telling axis first.
SIDES = {1: ("lower", "upper"), 0: ("left", "right"), 2: ("back", "front")}
#: Most words of a place, without words that only tell apart factors of one name.
WORDS = 2
#: Order of words in a name.
ORDER = ("inner", "outer", *(side for pair in SIDES.values() for side in pair), "middle", "whole shape")
#: Smallest divisor.
TINY = np.finfo(float).tiny


def names(
    groups: Sequence[Sequence[int]], nric: FloatArray, fields: FloatArray, norm: WeightedNorm, mean: TriangleMesh
) -> list[str]:
    """Name each factor by its place on the mean and by the motion of its strongest mode, such as "upper left bends".

    Places are those in a viewer that has x to the right, y up and z towards the eye (glTF's axes). A factor lies at the
    centre of its modes' squares. Factors of one name get a word for their relative place, or a number.

    Args:
        groups: modes of each factor, the strongest first.
        nric: (m, 2E) changes of lengths and angles.
        fields: (m, V, 3) vertex fields of the modes.
        norm: the norm at the mean.
        mean: the coarse mesh at the mean.
    """
    squares = edge_magnitudes(nric, norm) ** 2
    squares /= squares.sum(axis=1, keepdims=True)
    shares = np.array([squares[list(modes)].mean(axis=0) for modes in groups])
    centres = [_offset(share, mean)[0] for share in shares]
    plain = [
        (*_place(share, mean), _verb(motion(mean, fields[modes[0]], squares[modes[0]])))
        for share, modes in zip(shares, groups, strict=True)
    ]
    found = list(plain)
    for name, count in Counter(plain).items():
        if count > 1:
            alike = [k for k, each in enumerate(plain) if each == name]
            values = {pair: [centres[k][axis] for k in alike] for axis, pair in SIDES.items() if not {*pair} & {*name}}
            values["inner", "outer"] = [float(np.linalg.norm(centres[k])) for k in alike]
            for k, words in zip(alike, _told_apart(values, list(range(count))), strict=True):
                found[k] = (*sorted((*words, *name[:-1]), key=ORDER.index), name[-1])
    seen: Counter[str] = Counter()
    result: list[str] = []
    for words in found:
        said = " ".join(words)
        seen[said] += 1
        result.append(said if seen[said] == 1 else f"{said} {seen[said]}")
    return result


def _offset(share: FloatArray, mean: TriangleMesh) -> tuple[FloatArray, FloatArray]:
    """Return the centre (3,) of shares (E,) on edges and their width (3,), in standard deviations of the mesh; 0 on an
    axis along which the mesh is thin.
    """
    middles = mean.edge_midpoints
    spread = middles.std(axis=0)
    unit = np.where(spread >= THIN * spread.max(), spread, np.inf)
    place = share @ middles
    return (place - middles.mean(axis=0)) / unit, np.sqrt(share @ (middles - place) ** 2) / unit


def _place(share: FloatArray, mean: TriangleMesh) -> tuple[str, ...]:
    """Return the words for the place of shares (E,) on edges."""
    carried = share[mean.connectivity.face_edges].sum(axis=1)
    order = np.argsort(-carried / mean.face_areas)
    carrying = order[: 1 + int(np.searchsorted(carried[order].cumsum(), CARRIED * carried.sum()))]
    if mean.face_areas[carrying].sum() > WHOLE * mean.area:
        return ("whole shape",)
    offset, width = _offset(share, mean)
    far = np.abs(offset)
    aside = (far > ASIDE) | (far > np.maximum(width, CLEARLY))
    return tuple(pair[int(offset[axis] > 0)] for axis, pair in SIDES.items() if aside[axis])[:WORDS] or ("middle",)


def _told_apart(values: dict[tuple[str, str], list[float]], members: list[int]) -> list[tuple[str, ...]]:
    """Return words for members, from the pair of words whose values split them by the widest gap, and so on."""
    words: dict[int, tuple[str, ...]] = dict.fromkeys(members, ())
    best, pair, gap = None, None, APART
    for each, numbers in values.items():
        order = sorted(members, key=numbers.__getitem__)
        for k in range(1, len(order)):
            if numbers[order[k]] - numbers[order[k - 1]] > gap:
                best, pair, gap = (order[:k], order[k:]), each, numbers[order[k]] - numbers[order[k - 1]]
    if best is not None and pair is not None:
        rest = {other: numbers for other, numbers in values.items() if other != pair}
        for word, some in zip(pair, best, strict=True):
            for member, more in zip(sorted(some), _told_apart(rest, sorted(some)), strict=True):
                words[member] = (word, *more)
    return [words[member] for member in members]


class Motion(NamedTuple):
    """Measures that tell motions apart."""

    strain: float  # root mean square of the linear strain of faces
    turn: float  # root mean square of the rotation of faces about its mean
    one_axis: float  # share of its squares that is about one axis
    along: float  # cosine between this axis and the direction from the changes to the part that turns
    even: float  # share of the squares of the strain that one strain explains, where there is most strain
    all_round: float  # smallest principal value of this strain, as a share of the largest
    lengthwise: float  # cosine between its main direction and the longest axis of the strained part


def motion(mean: TriangleMesh, field: FloatArray, share: FloatArray) -> Motion:
    """Measure a vertex field (V, 3) on a mesh; shares (E,) say at which edges it changes the shape."""
    corners, moved = mean.vertices[mean.faces], field[mean.faces]
    centres, areas = corners.mean(axis=1), mean.face_areas / mean.area
    edges, changes = (np.roll(each, -1, axis=1) - each for each in (corners, moved))
    normals = face_normals(mean.vertices, mean.faces)
    tangent = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    gradient = np.swapaxes(changes, 1, 2) @ np.linalg.pinv(np.swapaxes(edges, 1, 2))
    strain = tangent @ (gradient + np.swapaxes(gradient, 1, 2)) @ tangent / 2
    sizes = np.linalg.norm(strain, axis=(1, 2))
    # The rotation whose changes of a face's edges come closest.
    inertia = (edges**2).sum(axis=(1, 2))[:, None, None] * np.eye(3) - np.swapaxes(edges, 1, 2) @ edges
    rotation = (np.linalg.pinv(inertia) @ np.cross(edges, changes).sum(axis=1)[:, :, None])[:, :, 0]
    rotation -= areas @ rotation
    about, axes = np.linalg.eigh((areas * rotation.T) @ rotation)
    # What turns is the smaller side.
    angles = rotation @ axes[:, 2]
    part = angles >= np.quantile(angles, (0.02, 0.98)).mean()
    part = part if areas[part].sum() < 0.5 else ~part
    arm = areas[part] @ centres[part] / max(areas[part].sum(), TINY) - share @ mean.edge_midpoints
    # The strain of space whose tangential parts come closest to the strain of faces.
    weights = areas * sizes / max(areas @ sizes, TINY)
    total = weights @ strain.reshape(-1, 9)
    projections = np.einsum("f,fij,fkl->ikjl", weights, tangent, tangent).reshape(9, 9)
    common = np.linalg.lstsq(projections, total, rcond=1e-6)[0]
    values, directions = np.linalg.eigh(common.reshape(3, 3))
    least, _, main = np.argsort(np.abs(values))
    away = centres - weights @ centres
    longest = np.linalg.eigh((weights * away.T) @ away)[1][:, 2]
    return Motion(
        strain=float(np.sqrt(areas @ sizes**2)),
        turn=float(np.sqrt(max(about.sum(), 0))),
        one_axis=float(about[2] / max(about.sum(), TINY)),
        along=float(abs(axes[:, 2] @ arm) / max(np.linalg.norm(arm), TINY)),
        even=float(common @ total / max(weights @ sizes**2, TINY)),
        all_round=float(values[least] / values[main]) if values[main] else 0.0,
        lengthwise=float(abs(directions[:, main] @ longest)),
    )


def _verb(found: Motion) -> str:
    if found.even > EVEN and found.strain > STRAINED * found.turn:
        if found.all_round > ALL_ROUND:
            return "grows"
        return "lengthens" if found.lengthwise > ALIKE else "widens"
    if found.one_axis > ONE_AXIS:
        return "turns" if found.along > ALIKE else "bends"
    return "bulges"
