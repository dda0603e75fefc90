"""A sequence of shapes as one animated GLB: morph targets, and the curves of their weights."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.colouring import Colouring
from shapespace.files.gltf_writing import GltfBuilder
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import diagonal

#: Up to this many frames each frame is a morph target of its own. Longer animations have a basis of at most this many
#: targets: every target has a weight in every frame, and viewers keep targets in a texture of at most 256 layers.
DENSE_FRAMES = 64
#: Enough targets are kept for every vertex to be within this distance, a fraction of the bounding box's diagonal.
BASIS_TOLERANCE = 1e-4
#: The default.
FRAMES_PER_SECOND = 30.0
#: Bytes of displacements, and frames of normals, that are held in memory at once.
BLOCK, _FRAMES_AT_ONCE = 2**21, 16


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


def animated_glb(
    frames: NDArray[np.floating],
    faces: IntArray,
    surface: MeshAttributes | None = None,
    fps: float = FRAMES_PER_SECOND,
    colourings: Sequence[Colouring] = (),
) -> AnimatedGLB:
    """Encode shapes (n, V, 3), with their surface where there is one, and with a colouring of each or of none.

    Key k, at ``k / fps`` seconds, shows frame k.
    The mesh at rest is frame 0. Up to DENSE_FRAMES each later frame is a target of its own, so that keys are
    exact to float32; longer sequences are spanned by the leading singular vectors of the displacements from
    frame 0. Weights lie between 0 and 1. The error is measured on what is written and stored in ``asset.extras`` too.

    Positions are float32. Displacements are never held in full: there may be hundreds of megabytes of them.
    """
    frames = frames.astype(np.float32, copy=False)
    rest = frames[0].astype(np.float64)
    weights: FloatArray
    fit: FloatArray
    if len(frames) <= DENSE_FRAMES:
        weights = fit = np.eye(len(frames) - 1)
    else:
        weights = _basis_weights(frames, BASIS_TOLERANCE * _diagonal(frames))
        fit = np.asarray(np.linalg.pinv(weights), np.float64)
        # Blender (at least up to 5.0) cuts off weights below 0: a vector with both signs becomes two targets.
        both = (weights < 0).any(axis=0)
        weights = np.hstack([weights.clip(0), -weights[:, both].clip(max=0)])
        fit = np.concatenate([fit, -fit[both]])
    keys = np.concatenate([np.zeros((1, len(fit))), weights]).astype(np.float32)
    targets = np.empty((len(fit), *rest.shape), np.float32)
    error = 0.0
    for block in _blocks(frames):
        displacements = frames[1:, block] - rest[block]
        targets[:, block] = np.tensordot(fit, displacements, 1)
        shown = np.tensordot(keys[1:].astype(np.float64), targets[:, block], 1)
        error = max(error, float(np.linalg.norm(shown - displacements, axis=-1).max(initial=0)))
    first = colourings[0] if colourings else None
    document = GltfBuilder(rest, faces, "animation", first, surface)
    normal_targets = _normal_targets(frames, document.normals, fit)
    if len(targets):
        document.add_targets(targets, normal_targets, colors=_colour_targets(colourings, fit) if first else None)
        times = np.arange(len(frames)) / fps
        document.tree["animations"] = [
            {
                "name": "animation",
                "samplers": [
                    {
                        "input": document.add(times, bounds=True),
                        "output": document.add(keys.ravel()),
                        "interpolation": "LINEAR",
                    }
                ],
                "channels": [{"sampler": 0, "target": {"node": k, "path": "weights"}} for k in range(document.nodes)],
            }
        ]
    document.tree["asset"]["extras"] = {
        "frames": len(frames),
        "targets": len(targets),
        "frames_per_second": fps,
        "max_vertex_error": error,
    }
    return AnimatedGLB(document.glb(), len(targets), error)


def _blocks(frames: NDArray[np.floating]) -> Iterator[slice]:
    """Ranges of vertices whose positions in all frames fit into BLOCK bytes as float64."""
    size = max(1, BLOCK // (24 * len(frames)))
    return (slice(start, start + size) for start in range(0, frames.shape[1], size))


def _normal_targets(
    frames: NDArray[np.floating], normals_of: Callable[[FloatArray], FloatArray], fit: FloatArray
) -> NDArray[np.float32]:
    """(K, V', 3): what each target adds to the normals, given how targets come from frames (K, n − 1)."""
    rest = normals_of(frames[0].astype(np.float64))
    targets = np.zeros((len(fit), *rest.shape), np.float32)
    for start in range(1, len(frames), _FRAMES_AT_ONCE):
        some = slice(start, min(start + _FRAMES_AT_ONCE, len(frames)))
        normals = np.stack([normals_of(frame.astype(np.float64)) - rest for frame in frames[some]])
        part = fit[:, some.start - 1 : some.stop - 1]
        for k in np.flatnonzero(part.any(axis=1)):
            targets[k] += np.tensordot(part[k], normals, 1).astype(np.float32)
    return targets


def _colour_targets(colourings: Sequence[Colouring], fit: FloatArray) -> Iterator[NDArray[np.float32]]:
    """What each target (V, 3) adds to the colours, given how targets come from frames (K, n − 1)."""
    rest = colourings[0].linear
    changes = np.stack([(each.linear - rest).astype(np.float32) for each in colourings[1:]])
    return (np.tensordot(row, changes, 1).astype(np.float32) for row in fit)


def _basis_weights(frames: NDArray[np.floating], tolerance: float) -> FloatArray:
    """Weights (n − 1, K) of the fewest leading singular vectors that bring every vertex within ``tolerance``.

    From the eigenvectors of the Gram matrix of the displacements from frame 0: n is far below 3V. K is at most
    DENSE_FRAMES.
    """

    def displacements(block: slice) -> FloatArray:
        moved = frames[1:, block].astype(np.float64) - frames[0, block]
        return moved.reshape(len(frames) - 1, -1)

    gram = np.zeros((len(frames) - 1, len(frames) - 1))
    for flat in map(displacements, _blocks(frames)):
        gram += flat @ flat.T
    values, vectors = np.linalg.eigh(gram)
    # Rank beyond rounding only: the rest is noise that a pseudo-inverse would blow up.
    vectors = vectors[:, ::-1][:, values[::-1] > 1e-12 * max(values[-1], 0)][:, :DENSE_FRAMES]
    left = np.zeros(vectors.shape[1] + 1)  # the largest distance with so many of them
    for flat in map(displacements, _blocks(frames)):
        for kept in range(len(left)):
            if kept:
                vector = vectors[:, kept - 1]
                flat -= np.outer(vector, vector @ flat)
            left[kept] = max(left[kept], np.linalg.norm(flat.reshape(len(flat), -1, 3), axis=-1).max())
    kept = int(np.argmax(left <= tolerance)) if (left <= tolerance).any() else len(left) - 1
    # Largest weight 1, and positive: eigenvectors have no sign of their own.
    weights: FloatArray = vectors[:, :kept]
    return weights / weights[np.abs(weights).argmax(axis=0), np.arange(kept)]


def _diagonal(frames: NDArray[np.floating]) -> float:
    corners = np.stack([frames.min(axis=(0, 1)), frames.max(axis=(0, 1))]).astype(np.float64)
    return float(diagonal(corners))
