"""Pictures of shapes, drawn with rays on the CPU: no display, no OpenGL, only the embreex wheel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.gltf_writing import vertex_normals
from shapespace.mesh.triangle_mesh import diagonal, face_normals

#: Degrees from which a shape is seen, to the right of its front and above it.
AZIMUTH, ELEVATION = 25.0, 18.0
#: Distance of the camera, in diagonals of all that is shown: from far away perspective distorts little.
DISTANCE = 2.5
#: Directions of lights in (right, up, towards the viewer), and their brightness.
LIGHTS = (((-0.55, 0.75, 0.65), 0.78), ((0.85, 0.10, 0.50), 0.20))
#: Ambient light on surfaces that face down, and on those that face up.
AMBIENT = (0.20, 0.46)
#: Wrap of diffuse light beyond the line where a surface turns away from it; 0 is plain Lambertian shading.
WRAP = 0.3
#: Rays from each vertex that test what occludes its ambient light.
OCCLUSION_RAYS = 96
#: Rays per pixel along each side, which smooths outlines.
SUPERSAMPLING = 2
GAMMA = 2.2
#: Margin around the shapes, a fraction of the picture's longer side.
MARGIN = 0.03


@dataclass(frozen=True)
class Camera:
    """A perspective camera; one serves all shapes of a run, so that their pictures compare.

    Attributes:
        axes: (3, 3) rows are the directions right, up and towards the viewer.
        eye: (3,) position.
        window: left, right, bottom and top of the picture, at one unit of length before the eye.
    """

    axes: FloatArray
    eye: FloatArray
    window: tuple[float, float, float, float]

    @classmethod
    def facing(cls, reference: FloatArray, faces: IntArray, shapes: ArrayLike = ()) -> Camera:
        """Choose a view of a reference shape (V, 3) whose picture holds all points of ``shapes`` (…, 3) as well.

        Collections come with any axis up. A shape is looked at along the coordinate axis in which it is thinnest,
        from its open side or, where it is closed, from where modelling tools have their front view; up is y, or z
        where y is the line of sight.
        """
        thin = int(np.argmin(reference.std(axis=0)))
        normals = face_normals(reference, faces, normalised=False)
        openness = normals.sum(axis=0)[thin] / np.linalg.norm(normals, axis=1).sum()
        side = np.sign(openness) if abs(openness) > 0.05 else -1.0 if thin == 1 else 1.0
        towards, up = side * np.eye(3)[thin], np.eye(3)[2 if thin == 1 else 1]
        azimuth, elevation = math.radians(AZIMUTH), math.radians(ELEVATION)
        level = math.cos(azimuth) * towards + math.sin(azimuth) * np.cross(up, towards)
        back = math.cos(elevation) * level + math.sin(elevation) * up
        right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
        axes = np.stack([right, np.cross(back, right), back])

        points = np.concatenate([reference, np.reshape(shapes, (-1, 3))])
        low, high = points.min(axis=0), points.max(axis=0)
        eye = (low + high) / 2 + DISTANCE * np.linalg.norm(high - low) * back
        return cls(axes, eye, (-1.0, 1.0, -1.0, 1.0)).framing(points, MARGIN)

    def framing(self, points: FloatArray, margin: float) -> Camera:
        """The same view, cut to points (n, 3) and a margin around them, a fraction of the picture's longer side."""
        local = (points - self.eye) @ self.axes.T
        screen = local[:, :2] / -local[:, 2:]
        low, high = screen.min(axis=0), screen.max(axis=0)
        border = margin * (high - low).max()
        (left, bottom), (right, top) = low - border, high + border
        return replace(self, window=(float(left), float(right), float(bottom), float(top)))

    def render(
        self, vertices: FloatArray, faces: IntArray, colours: ArrayLike, size: int, *, smooth: bool = True
    ) -> NDArray[np.uint8]:
        """Draw a shape before a transparent background.

        Args:
            vertices: (V, 3) positions.
            faces: (F, 3) vertex indices.
            colours: (V, 3) or (3,) sRGB between 0 and 1.
            size: pixels of the picture's longer side.
            smooth: shade by normals of vertices; by those of faces otherwise, which shows the triangles.

        Returns:
            (height, width, 4) sRGB and coverage.
        """
        # Imported here: there are platforms without this wheel, and everything but pictures works there.
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        vertices = (vertices - self.eye) @ self.axes.T
        scene = EmbreeScene()
        TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
        normals = vertex_normals(vertices, faces)
        light = _ambient(scene, vertices, normals)

        left, right, bottom, top = self.window
        pixel = max(right - left, top - bottom) / size
        height, width = round((top - bottom) / pixel), round((right - left) / pixel)
        rays = _rays(self.window, SUPERSAMPLING * height, SUPERSAMPLING * width)
        hit = scene.run(np.zeros_like(rays), rays, output=True)
        seen = hit["primID"] >= 0
        rays, face, u, v = rays[seen], hit["primID"][seen], hit["u"][seen, None], hit["v"][seen, None]

        albedo = np.broadcast_to(np.asarray(colours) ** GAMMA, vertices.shape)
        corners = np.hstack([normals, albedo, light[:, None]]).astype(np.float32)[faces]
        a, b, c = (corners[face, corner] for corner in range(3))
        normal, albedo, light = np.split((1 - u - v) * a + u * b + v * c, [3, 6], axis=1)
        front = np.einsum("ij,ij->i", hit["Ng"][seen], rays) < 0
        if not smooth:
            normal = hit["Ng"][seen]
        # Surfaces have two equal sides. The face tells which is seen: at a sharp edge the smooth normal may look away.
        normal = np.where(front[:, None], normal, -normal)

        picture = np.zeros((SUPERSAMPLING**2 * height * width, 4), dtype=np.float32)
        picture[seen, :3], picture[seen, 3] = _shade(normal, -rays, albedo, light), 1
        # Averages are taken of light, not of its encoding, and weighted by coverage: no dark seam at outlines.
        picture = np.mean(
            [picture.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 4)[:, i, :, j]
             for i in range(SUPERSAMPLING) for j in range(SUPERSAMPLING)],
            axis=0,
        )  # fmt: skip
        coverage = picture[..., 3:]
        picture[..., :3] = (picture[..., :3] / np.where(coverage > 0, coverage, 1)).clip(0, 1) ** (1 / GAMMA)
        return (255 * picture + 0.5).astype(np.uint8)


@lru_cache(maxsize=4)
def _rays(window: tuple[float, float, float, float], height: int, width: int) -> NDArray[np.float32]:
    """Directions (height·width, 3) through the pixels of a picture, row by row from the top."""
    left, right, bottom, top = window
    x = left + (right - left) * (np.arange(width) + 0.5) / width
    y = top - (top - bottom) * (np.arange(height) + 0.5) / height
    rays = np.stack([np.tile(x, height), np.repeat(y, width), np.full(height * width, -1.0)], axis=1)
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)


def _ambient(scene: object, vertices: FloatArray, normals: FloatArray) -> FloatArray:
    """Part (V,) of the light from all sides that reaches each vertex: creases and armpits are darker."""
    k = np.arange(OCCLUSION_RAYS) + 0.5
    z, turn = 1 - 2 * k / OCCLUSION_RAYS, math.pi * (1 + math.sqrt(5)) * k  # evenly over the sphere (Fibonacci)
    ring = np.sqrt(1 - z**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    weight = normals @ directions.T
    vertex, direction = np.nonzero(weight > 0.1)
    weight = weight[vertex, direction]
    origins = vertices + 2e-3 * diagonal(vertices) * normals
    free = scene.run(  # type: ignore[attr-defined]
        origins[vertex].astype(np.float32), directions[direction].astype(np.float32), query="OCCLUDED"
    )
    count = len(vertices)
    return np.bincount(vertex, weight * (free < 0), count) / np.bincount(vertex, weight, count).clip(1e-9)


def _shade(normal: NDArray, view: NDArray, albedo: NDArray, ambient: NDArray) -> NDArray:
    """Linear light (n, 3) that leaves n points towards the viewer; float32 throughout, for speed."""
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)
    low, high = AMBIENT
    light = ambient * (low + (high - low) * (0.5 + 0.5 * normal[:, 1:2]))
    gloss = 0.06 * (1 - np.einsum("ij,ij->i", normal, view)).clip(0, 1)[:, None] ** 3
    for direction, brightness in LIGHTS:
        towards = (np.array(direction) / np.linalg.norm(direction)).astype(np.float32)
        light += brightness * ((normal @ towards + WRAP) / (1 + WRAP)).clip(0)[:, None] * (0.4 + 0.6 * ambient)
        halfway = view + towards
        cosine = np.einsum("ij,ij->i", normal, halfway) / np.linalg.norm(halfway, axis=1)
        gloss += 0.08 * brightness * cosine.clip(0)[:, None] ** 40
    return albedo * light + gloss
