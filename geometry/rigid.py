"""Infinitesimal rigid motions: what no length and no angle can see."""

from __future__ import annotations

import numpy as np

from geometry.mesh import FloatArray


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
