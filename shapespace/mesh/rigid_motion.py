"""Rigid motions, which no length and no angle can see: alignment, and the infinitesimal ones."""

from __future__ import annotations

import numpy as np

from shapespace.arrays import FloatArray


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
