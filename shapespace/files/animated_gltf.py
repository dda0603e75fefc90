"""GLB files with morph targets: animations with curves of their weights, and blend shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.colouring import Colouring
from shapespace.files.gltf_writing import GltfBuilder
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import diagonal

#: Up to this number of frames, each frame is a morph target. Longer animations have a basis of at most this number of
#: vectors, because every target has a weight in every frame, and viewers keep targets in a texture of 256 layers.
DENSE_FRAMES = 64
#: Largest distance of a vertex from its position, as a fraction of the bounding box's diagonal, that the basis aims at.
BASIS_TOLERANCE = 1e-4
#: Default frame rate.
FRAMES_PER_SECOND = 30.0
#: Bytes of displacements that are in memory at once.
BLOCK = 2**21
#: Frames whose normals are in memory at once.
_FRAMES_AT_ONCE = 16


@dataclass(frozen=True)
class AnimatedGLB:
    """An encoded animation.

    Attributes:
        data: content of the GLB file.
        targets: number of morph targets.
        max_vertex_error: largest distance of a vertex from its position in a key frame, in the unit of the vertices.
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
    name: str = "animation",
) -> AnimatedGLB:
    """Encode shapes (n, V, 3) as an animation whose key k, at ``k / fps`` seconds, shows frame k.

    Frame 0 is the mesh at rest. Up to DENSE_FRAMES frames, each later frame is a target, so that keys are exact to
    float32. Longer sequences use the leading singular vectors of the displacements from frame 0 as targets, unless
    these would be as many as the frames. Weights are between 0 and 1. Targets are named "frame 1", "frame 2", … or
    "component 1", …. The vertex error is measured on the written values, and is in ``asset.extras`` too.

    Positions are float32. Displacements are computed block by block, because together they can take hundreds of
    megabytes.

    Args:
        frames: (n, V, 3) positions.
        faces: (F, 3).
        surface: polygons, texture coordinates and materials of the mesh, if any.
        fps: frames per second.
        colourings: colours for each frame, or empty.
        name: name of the animation and of the mesh.
    """
    frames = frames.astype(np.float32, copy=False)
    rest = frames[0].astype(np.float64)
    weights, fit = _weights_and_fit(frames)
    keys = np.concatenate([np.zeros((1, len(fit))), weights]).astype(np.float32)
    targets = np.empty((len(fit), *rest.shape), np.float32)
    error = 0.0
    for block in _blocks(frames):
        displacements = frames[1:, block] - rest[block]
        targets[:, block] = np.tensordot(fit, displacements, 1)
        shown = np.tensordot(keys[1:].astype(np.float64), targets[:, block], 1)
        error = max(error, float(np.linalg.norm(shown - displacements, axis=-1).max(initial=0)))
    first = colourings[0] if colourings else None
    document = GltfBuilder(rest, faces, first, surface, name=name)
    normal_targets = _normal_targets(frames, document.normals, fit)
    if len(targets):
        kind = "frame" if len(fit) == len(frames) - 1 else "component"
        names = [f"{kind} {k}" for k in range(1, len(targets) + 1)]
        document.add_targets(targets, normal_targets, names, _colour_targets(colourings, fit) if first else None)
        times = document.add(np.arange(len(frames)) / fps, bounds=True)
        sampler = {"input": times, "output": document.add(keys.ravel()), "interpolation": "LINEAR"}
        channels = [{"sampler": 0, "target": {"node": k, "path": "weights"}} for k in range(document.nodes)]
        document.tree["animations"] = [{"name": name, "samplers": [sampler], "channels": channels}]
    document.tree["asset"]["extras"] = {
        "frames": len(frames),
        "targets": len(targets),
        "frames_per_second": fps,
        "max_vertex_error": error,
    }
    return AnimatedGLB(document.glb(), len(targets), error)


def _weights_and_fit(frames: NDArray[np.floating]) -> tuple[FloatArray, FloatArray]:
    """Return the weights (n - 1, k) of the later frames, and the matrix (k, n - 1) from displacements to targets."""
    each = np.eye(len(frames) - 1)
    if len(frames) <= DENSE_FRAMES:
        return each, each
    corners = np.stack([frames.min(axis=(0, 1)), frames.max(axis=(0, 1))]).astype(np.float64)
    weights = _basis_weights(frames, BASIS_TOLERANCE * float(diagonal(corners)))
    # Blender, at least up to 5.0, clips weights below 0. So a vector with both signs becomes two targets.
    both = (weights < 0).any(axis=0)
    if weights.shape[1] + both.sum() >= len(each):
        return each, each
    fit = np.asarray(np.linalg.pinv(weights), np.float64)
    return np.hstack([weights.clip(0), -weights[:, both].clip(max=0)]), np.concatenate([fit, -fit[both]])


def _blocks(frames: NDArray[np.floating]) -> Iterator[slice]:
    """Yield ranges of vertices whose positions in all frames take at most BLOCK bytes as float64."""
    size = max(1, BLOCK // (24 * len(frames)))
    return (slice(start, start + size) for start in range(0, frames.shape[1], size))


def _normal_targets(
    frames: NDArray[np.floating], normals_of: Callable[[FloatArray], FloatArray], fit: FloatArray
) -> NDArray[np.float32]:
    """Return the changes of normals (K, V', 3) by the targets; ``fit`` (K, n − 1) maps frames to targets."""
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
    """Yield the change of colours (V, 3) by each target; ``fit`` (K, n − 1) maps frames to targets."""
    rest = colourings[0].linear
    changes = np.stack([(each.linear - rest).astype(np.float32) for each in colourings[1:]])
    return (np.tensordot(row, changes, 1).astype(np.float32) for row in fit)


def _basis_weights(frames: NDArray[np.floating], tolerance: float) -> FloatArray:
    """Return weights (n − 1, K) of the fewest leading singular vectors for which the vertex error is ≤ ``tolerance``.

    They are eigenvectors of the Gram matrix of the displacements from frame 0, because n is far below 3V. K is at most
    DENSE_FRAMES.
    """

    def displacements(block: slice) -> FloatArray:
        moved = frames[1:, block].astype(np.float64) - frames[0, block]
        return moved.reshape(len(frames) - 1, -1)

    gram = np.zeros((len(frames) - 1, len(frames) - 1))
    for flat in map(displacements, _blocks(frames)):
        gram += flat @ flat.T
    values, vectors = np.linalg.eigh(gram)
    # Vectors below rounding are noise, which a pseudo-inverse would amplify.
    vectors = vectors[:, ::-1][:, values[::-1] > 1e-12 * max(values[-1], 0)][:, :DENSE_FRAMES]
    left = np.zeros(vectors.shape[1] + 1)  # largest vertex error for each number of vectors
    for flat in map(displacements, _blocks(frames)):
        for kept in range(len(left)):
            if kept:
                vector = vectors[:, kept - 1]
                flat -= np.outer(vector, vector @ flat)
            left[kept] = max(left[kept], np.linalg.norm(flat.reshape(len(flat), -1, 3), axis=-1).max())
    kept = int(np.argmax(left <= tolerance)) if (left <= tolerance).any() else len(left) - 1
    # The sign of an eigenvector is arbitrary: make the largest weight of each 1.
    weights: FloatArray = vectors[:, :kept]
    return weights / weights[np.abs(weights).argmax(axis=0), np.arange(kept)]


def blend_shapes_glb(
    rest: FloatArray,
    ends: FloatArray,
    names: Sequence[str],
    faces: IntArray,
    surface: MeshAttributes | None = None,
    extras: Mapping[str, Any] | None = None,
) -> bytes:
    """Encode a rest shape, and shapes that a weight of 1 of their morph target leads to.

    Args:
        rest: (V, 3) rest shape, in any unit.
        ends: (n, V, 3) shapes of the morph targets.
        names: names of the morph targets. They go into ``extras.targetNames`` of the mesh, where Blender and three.js
            look for them.
        faces: (F, 3).
        surface: polygons, texture coordinates and materials of the mesh, if any.
        extras: ``extras`` of the file's ``asset``.
    """
    document = GltfBuilder(rest, faces, surface=surface, joined=True)
    normals = document.normals(rest)
    document.add_targets((end - rest for end in ends), (document.normals(end) - normals for end in ends), names)
    if extras:
        document.tree["asset"]["extras"] = dict(extras)
    return document.glb()
