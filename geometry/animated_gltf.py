"""A sequence of shapes as one animated GLB: morph targets, and the curves of their weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.gltf import ARRAY_BUFFER, Document, vertex_normals
from geometry.mesh import FloatArray, IntArray, diagonal

#: Up to this many frames each frame has a target of its own; beyond it, a basis of this many vectors at most. Keying
#: every target in every frame takes N² weights, and viewers keep targets in a texture of at most 256 layers.
DENSE_FRAMES = 64
#: Enough targets are kept to bring every vertex this close, as a fraction of the bounding box's diagonal.
BASIS_TOLERANCE = 1e-4
FRAMES_PER_SECOND = 30


@dataclass(frozen=True)
class AnimatedGLB:
    """An encoded animation.

    Attributes:
        data: the GLB.
        targets: number of morph targets.
        max_vertex_error: largest distance of a vertex at a key from where it should be, in the unit of the
            vertices.
    """

    data: bytes
    targets: int
    max_vertex_error: float


def animated_glb(frames: FloatArray, faces: IntArray) -> AnimatedGLB:
    """Encode shapes (n, V, 3) so that key k, at ``k / FRAMES_PER_SECOND`` seconds, shows frame k.

    The mesh at rest is frame 0. Up to DENSE_FRAMES each later frame is a target of its own, so that keys are
    exact to float32; longer sequences are spanned by the leading singular vectors of the displacements from
    frame 0. Weights lie between 0 and 1. The error is measured on what is written and stored in ``asset.extras`` too.
    """
    frames = frames.astype(np.float32).astype(np.float64)
    displacements = frames[1:] - frames[0]
    normals = np.stack([vertex_normals(frame, faces) for frame in frames])
    if len(frames) <= DENSE_FRAMES:
        weights, targets = np.eye(len(frames) - 1), displacements
        normal_targets = normals[1:] - normals[0]
    else:
        weights = _basis_weights(displacements, BASIS_TOLERANCE * float(diagonal(frames.reshape(-1, 3))))
        fit = np.linalg.pinv(weights)
        targets = np.tensordot(fit, displacements, 1)
        normal_targets = np.tensordot(fit, normals[1:] - normals[0], 1)
        # Blender cuts weights off below 0 (up to 5.0 at least), so who goes both ways becomes two targets.
        both = (weights < 0).any(axis=0)
        weights = np.hstack([weights.clip(0), -weights[:, both].clip(max=0)])
        targets, normal_targets = (np.concatenate([t, -t[both]]) for t in (targets, normal_targets))
    weights = np.concatenate([np.zeros((1, len(targets))), weights]).astype(np.float32)
    targets = targets.astype(np.float32)
    shown = np.tensordot(weights[1:].astype(np.float64), targets, 1)
    error = float(np.linalg.norm(shown - displacements, axis=-1).max(initial=0))

    document = Document(frames[0], faces, "animation")
    if len(targets):
        document.primitive["targets"] = [
            {
                "POSITION": document.add(target, bounds=True, target=ARRAY_BUFFER),
                "NORMAL": document.add(normal_target, target=ARRAY_BUFFER),
            }
            for target, normal_target in zip(targets, normal_targets, strict=True)
        ]
        document.mesh["weights"] = [0.0] * len(targets)
        times = np.arange(len(frames)) / FRAMES_PER_SECOND
        document.tree["animations"] = [
            {
                "name": "animation",
                "samplers": [
                    {
                        "input": document.add(times, bounds=True),
                        "output": document.add(weights.ravel()),
                        "interpolation": "LINEAR",
                    }
                ],
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
            }
        ]
    document.tree["asset"]["extras"] = {
        "frames": len(frames),
        "targets": len(targets),
        "frames_per_second": FRAMES_PER_SECOND,
        "max_vertex_error": error,
    }
    return AnimatedGLB(document.glb(), len(targets), error)


def _basis_weights(displacements: FloatArray, tolerance: float) -> FloatArray:
    """Weights (n, K) of the fewest leading singular vectors that bring every vertex within ``tolerance``.

    From the eigenvectors of the n × n Gram matrix: n is far below 3V. K is at most DENSE_FRAMES.
    """
    flat = displacements.reshape(len(displacements), -1)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    # Rank beyond rounding only: the rest is noise that a pseudo-inverse would blow up.
    vectors = vectors[:, ::-1][:, values[::-1] > 1e-12 * max(values[-1], 0)]
    rest, kept = flat.copy(), 0
    for vector in vectors.T[:DENSE_FRAMES]:
        if np.linalg.norm(rest.reshape(displacements.shape), axis=-1).max() <= tolerance:
            break
        rest -= np.outer(vector, vector @ rest)
        kept += 1
    # Largest weight 1, and positive: eigenvectors have no sign of their own.
    weights = vectors[:, :kept]
    return weights / weights[np.abs(weights).argmax(axis=0), np.arange(kept)]
