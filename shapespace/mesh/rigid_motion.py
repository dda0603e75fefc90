"""Rigid motions, which no length and no angle can see: alignment, and the infinitesimal ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray

#: Singular values of rigid motions below this share of the largest are treated as zero.
RANK = 1e-9


@dataclass(frozen=True, eq=False)
class Placement:
    """Takes points from one frame to another: ``x ↦ scale · rotation · x + translation``.

    Attributes:
        rotation: (3, 3), without reflection.
        translation: (3,) in the units of the frame that points are taken to.
        scale: a factor.
    """

    rotation: FloatArray
    translation: FloatArray
    scale: float = 1.0

    def __call__(self, points: FloatArray) -> FloatArray:
        """Points (…, 3) in the other frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def back(self, points: FloatArray) -> FloatArray:
        """Points (…, 3) of the other frame in the first one."""
        return (points - self.translation) @ self.rotation / self.scale

    def after(self, first: Placement) -> Placement:
        """This one applied to what ``first`` has placed."""
        return Placement(self.rotation @ first.rotation, self(first.translation), self.scale * first.scale)

    @classmethod
    def between(
        cls, points: FloatArray, there: FloatArray, weights: FloatArray | None = None, *, scaled: bool = False
    ) -> Placement:
        """What brings points (n, 3) closest to others (n, 3) in weighted least squares (Umeyama 1991).

        Args:
            points: (n, 3).
            there: (n, 3).
            weights: (n,), by default equal ones.
            scaled: whether the scale is found too, which is 1 otherwise.
        """
        share = np.full(len(points), 1 / len(points)) if weights is None else weights / weights.sum()
        middle, centre = share @ points, share @ there
        x, y = points - middle, there - centre
        u, s, vt = np.linalg.svd((share[:, None] * x).T @ y)
        sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
        rotation = vt.T @ (u * sign).T
        spread = float((share[:, None] * x * x).sum())
        scale = float((s * sign).sum() / max(spread, np.finfo(float).tiny)) if scaled else 1.0
        return cls(rotation, centre - scale * rotation @ middle, scale)

    def angle_to(self, other: Placement) -> float:
        """Angle between the rotations, in radians."""
        return float(np.arccos(np.clip((np.trace(self.rotation @ other.rotation.T) - 1) / 2, -1, 1)))


def rigid_motions(vertices: FloatArray) -> FloatArray:
    """(6, 3V) orthonormal basis of the infinitesimal rigid motions of a shape (V, 3)."""
    count = len(vertices)
    x = vertices - vertices.mean(axis=0)
    # About the principal axes rotations are orthogonal to each other.
    moments, axes = np.linalg.eigh(x.T @ x)
    motions = np.zeros((6, count, 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        motions[k, :, k] = count**-0.5
        turn = np.outer(axes[:, i], axes[:, j])
        np.matmul(x, (turn - turn.T) * (moments[i] + moments[j]) ** -0.5, out=motions[3 + k])
    return motions.reshape(6, -1)


def without_rigid_motion(displacement: FloatArray, vertices: FloatArray) -> FloatArray:
    """The part of vertex fields (…, V, 3) orthogonal to infinitesimal rigid motions of a shape.

    A velocity of lengths and angles determines a vertex field only up to these, yet adding one changes
    discrete results. The field without them is what aligning two shapes in least squares leaves to first
    order *and* exactly: if X_1 is aligned to X_0, then X_1 − X_0 has no such part.
    """
    motions = rigid_motions(vertices)
    flat = displacement.reshape(*displacement.shape[:-2], -1)
    return (flat - (flat @ motions.T) @ motions).reshape(displacement.shape)


def weighted_change(
    fields: FloatArray, points: FloatArray, weights: FloatArray, aligned: FloatArray | None = None
) -> FloatArray:
    """How weighted misfits (n, k, 3) of points (k, 3) change where the points move by fields (n, k, 3).

    A misfit is ``√w (x − target)`` after ``Placement.between``, which takes the infinitesimal rigid motion next to each
    field away, exactly so where there is no misfit. The placement is by the weights ``aligned`` (k,), where these are
    others.
    """
    aligned = weights if aligned is None else aligned
    x = points - aligned @ points / aligned.sum()
    motions = np.zeros((6, *x.shape))
    for k in range(3):
        motions[k, :, k] = 1
        motions[3 + k] = np.cross(np.eye(3)[k], x)
    roots = np.sqrt(aligned)[:, None]
    # No rotation about a line of points is seen.
    inverse = np.linalg.pinv((roots * motions).reshape(6, -1), rcond=RANK)
    motion = (roots * fields).reshape(len(fields), -1) @ inverse
    return np.sqrt(weights)[:, None] * (fields - np.tensordot(motion, motions, 1))


def aligned_change(vertices: FloatArray, fields: FloatArray, target: FloatArray) -> FloatArray:
    """How a shape (V, 3) aligned to a target (V, 3) changes where the shape changes by vertex fields (n, V, 3).

    To first order, and as far as the two are alike: turned as the shape is, and without the rigid motion that alignment
    takes away.
    """
    there = align(vertices, target)
    return without_rigid_motion(align(vertices, target, carried=vertices + fields) - there, there)


def align(vertices: FloatArray, target: FloatArray, carried: FloatArray | None = None) -> FloatArray:
    """Move shapes (…, V, 3) rigidly to come closest to targets (…, V, 3) in least squares over vertices.

    Kabsch's method: rotation and translation, no reflection, no scaling. Instead of the shapes themselves other points
    (…, n, 3) can be moved as they are, ``carried``.
    """
    # Means by products: ten times as fast as `mean` over rows of three.
    share = np.full((1, vertices.shape[-2]), 1 / vertices.shape[-2])
    centre, middle = share @ vertices, share @ target
    x, y = vertices - centre, target - middle
    u, _, vt = np.linalg.svd(np.swapaxes(x, -1, -2) @ y)
    u[..., :, -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return (x if carried is None else carried - centre) @ (u @ vt) + middle
