"""Rigid motions, which change no length and no angle: alignment, and infinitesimal rigid motions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray

#: Singular values of rigid motions below this share of the largest one count as zero.
RANK = 1e-9


@dataclass(frozen=True, eq=False)
class Placement:
    """A similarity between two frames: ``x ↦ scale · rotation · x + translation``.

    Attributes:
        rotation: (3, 3), without reflection.
        translation: (3,) in the unit of the target frame.
        scale: factor on lengths.
    """

    rotation: FloatArray
    translation: FloatArray
    scale: float = 1.0

    def __call__(self, points: FloatArray) -> FloatArray:
        """Map points (…, 3) to the target frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def back(self, points: FloatArray) -> FloatArray:
        """Map points (…, 3) of the target frame back."""
        return (points - self.translation) @ self.rotation / self.scale

    def after(self, first: Placement) -> Placement:
        """Return the composition: ``first``, then this placement."""
        return Placement(self.rotation @ first.rotation, self(first.translation), self.scale * first.scale)

    def answer(self) -> dict[str, Any]:
        """Return the members of the JSON answer."""
        rotation = np.ascontiguousarray(self.rotation)  # JSON writers need contiguous arrays
        return {"rotation": rotation, "translation": self.translation, "scale": self.scale}

    @classmethod
    def between(
        cls, points: FloatArray, there: FloatArray, weights: FloatArray | None = None, *, scaled: bool = False
    ) -> Placement:
        """Find the placement that brings points closest to others in weighted least squares (Umeyama 1991).

        Points and their positions ``there`` are (n, 3), weights (n,), equal by default. The scale is 1 unless it is
        fitted too.
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
        """Compute the angle between the two rotations, in radians."""
        return float(np.arccos(np.clip((np.trace(self.rotation @ other.rotation.T) - 1) / 2, -1, 1)))


def rigid_motions(vertices: FloatArray) -> FloatArray:
    """Compute an orthonormal basis (6, 3V) of the infinitesimal rigid motions of a shape (V, 3)."""
    count = len(vertices)
    x = vertices - vertices.mean(axis=0)
    # Rotations about the principal axes are orthogonal to each other.
    moments, axes = np.linalg.eigh(x.T @ x)
    motions = np.zeros((6, count, 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        motions[k, :, k] = count**-0.5
        turn = np.outer(axes[:, i], axes[:, j])
        np.matmul(x, (turn - turn.T) * (moments[i] + moments[j]) ** -0.5, out=motions[3 + k])
    return motions.reshape(6, -1)


def without_rigid_motion(displacement: FloatArray, vertices: FloatArray) -> FloatArray:
    """Project vertex fields (…, V, 3) orthogonally to the infinitesimal rigid motions of a shape.

    A velocity of lengths and angles determines a vertex field only up to rigid motions, but rigid motions change
    discrete results. The projection corresponds to least-squares alignment, to first order *and* exactly: if X_1 is
    aligned to X_0, then X_1 − X_0 has no rigid part.
    """
    motions = rigid_motions(vertices)
    flat = displacement.reshape(*displacement.shape[:-2], -1)
    return (flat - (flat @ motions.T) @ motions).reshape(displacement.shape)


def weighted_change(
    fields: FloatArray, points: FloatArray, weights: FloatArray, aligned: FloatArray | None = None
) -> FloatArray:
    """Compute the changes (n, k, 3) of weighted misfits of points (k, 3) when the points move by fields (n, k, 3).

    A misfit is ``√w (x − target)`` after ``Placement.between``. The placement removes the infinitesimal rigid motion
    closest to each field; this is exact where the misfit is zero. ``aligned`` (k,) are the weights of the placement, if
    they differ from ``weights``.
    """
    aligned = weights if aligned is None else aligned
    x = points - aligned @ points / aligned.sum()
    motions = np.zeros((6, *x.shape))
    for k in range(3):
        motions[k, :, k] = 1
        motions[3 + k] = np.cross(np.eye(3)[k], x)
    roots = np.sqrt(aligned)[:, None]
    # Points on a line don't determine the rotation about it.
    inverse = np.linalg.pinv((roots * motions).reshape(6, -1), rcond=RANK)
    motion = (roots * fields).reshape(len(fields), -1) @ inverse
    return np.sqrt(weights)[:, None] * (fields - np.tensordot(motion, motions, 1))


def aligned_change(vertices: FloatArray, fields: FloatArray, target: FloatArray) -> FloatArray:
    """Compute the change of a shape (V, 3) aligned to a target (V, 3) when the shape changes by fields (n, V, 3).

    To first order, for shapes close to the target: the fields are rotated with the shape, and alignment removes their
    rigid part.
    """
    there = align(vertices, target)
    return without_rigid_motion(align(vertices, target, carried=vertices + fields) - there, there)


def align(vertices: FloatArray, target: FloatArray, carried: FloatArray | None = None) -> FloatArray:
    """Align shapes (…, V, 3) rigidly to targets (…, V, 3) in least squares over the vertices.

    Kabsch's method: rotation and translation, no reflection, no scaling. With ``carried``, the same motion is applied
    to other points (…, n, 3) instead of the shapes.
    """
    # Matrix products compute means ten times as fast as `mean` over rows of three.
    share = np.full((1, vertices.shape[-2]), 1 / vertices.shape[-2])
    centre, middle = share @ vertices, share @ target
    x, y = vertices - centre, target - middle
    u, _, vt = np.linalg.svd(np.swapaxes(x, -1, -2) @ y)
    u[..., :, -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return (x if carried is None else carried - centre) @ (u @ vt) + middle
