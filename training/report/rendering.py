"""Pictures of shapes by ray casting on the CPU: without a display or OpenGL, only with the package embreex."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import diagonal, face_normals, vertex_normals


@dataclass(frozen=True)
class RenderingSettings:
    """View, light and quality of all pictures."""

    azimuth: float = 25.0  # degrees to the right of the shape's front
    elevation: float = 18.0  # degrees above the shape's front
    distance: float = 2.5  # of the camera, in diagonals of all shapes: from far away, perspective distorts little
    margin: float = 0.03  # space around the shapes, a share of the picture's longer side
    # For each light its direction (right, up, towards the viewer) and its brightness.
    lights: tuple[tuple[tuple[float, float, float], float], ...] = (
        ((-0.55, 0.75, 0.65), 0.78),
        ((0.85, 0.10, 0.50), 0.20),
    )
    ambient: tuple[float, float] = (0.20, 0.46)  # ambient light on surfaces that face down, and that face up
    wrap: float = 0.3  # how far diffuse light reaches around a surface that turns away from it; 0 is Lambertian
    occlusion_rays: int = 96  # number of rays from each vertex that test which directions are occluded
    supersampling: int = 2  # rays per pixel along each side, which smooths outlines
    gamma: float = 2.2  # exponent between light and its encoding as sRGB


SETTINGS = RenderingSettings()


@dataclass(frozen=True)
class Camera:
    """A perspective camera. All shapes of a run have the same camera, so that their pictures can be compared."""

    axes: FloatArray  # (3, 3) directions right, up and towards the viewer, as rows
    eye: FloatArray  # (3,) position
    # Left, right, bottom and top of the picture, at one unit of length before the eye.
    window: tuple[float, float, float, float]

    @classmethod
    def facing(cls, reference: FloatArray, faces: IntArray, shapes: ArrayLike = ()) -> Camera:
        """Choose a view of a reference shape (V, 3) whose picture also holds all points of ``shapes`` (…, 3).

        Any axis of a collection may point up. The camera looks along the axis in which the shape is thinnest. It looks
        at the shape's open side, or at the front as modelling tools define it if the shape is closed. In the picture y
        points up, or z if the camera looks along y.
        """
        thin = int(np.argmin(reference.std(axis=0)))
        normals = face_normals(reference, faces, normalised=False)
        openness = normals.sum(axis=0)[thin] / np.linalg.norm(normals, axis=1).sum()
        side = np.sign(openness) if abs(openness) > 0.05 else -1.0 if thin == 1 else 1.0
        towards, up = side * np.eye(3)[thin], np.eye(3)[2 if thin == 1 else 1]
        azimuth, elevation = math.radians(SETTINGS.azimuth), math.radians(SETTINGS.elevation)
        level = math.cos(azimuth) * towards + math.sin(azimuth) * np.cross(up, towards)
        back = math.cos(elevation) * level + math.sin(elevation) * up
        right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
        axes = np.stack([right, np.cross(back, right), back])

        points = np.concatenate([reference, np.reshape(shapes, (-1, 3))])
        low, high = points.min(axis=0), points.max(axis=0)
        eye = (low + high) / 2 + SETTINGS.distance * np.linalg.norm(high - low) * back
        return cls(axes, eye, (-1.0, 1.0, -1.0, 1.0)).framing(points, SETTINGS.margin)

    def framing(self, points: FloatArray, margin: float) -> Camera:
        """Return the same view, cut to points (n, 3) and a margin, a share of the picture's longer side."""
        local = (points - self.eye) @ self.axes.T
        screen = local[:, :2] / -local[:, 2:]
        low, high = screen.min(axis=0), screen.max(axis=0)
        border = margin * (high - low).max()
        (left, bottom), (right, top) = low - border, high + border
        return replace(self, window=(float(left), float(right), float(bottom), float(top)))

    def render(
        self, vertices: FloatArray, faces: IntArray, colours: ArrayLike, size: int, *, smooth: bool = True
    ) -> NDArray[np.uint8]:
        """Draw a shape on a transparent background.

        Colours, (V, 3) or (3,), are sRGB between 0 and 1. The picture's longer side has ``size`` pixels. If not
        ``smooth``, shading is by normals of faces, which show the triangles. Returns (height, width, 4) sRGB and
        coverage.
        """
        # Imported here, because everything but pictures also works on platforms without this package.
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
        fine = SETTINGS.supersampling
        rays = _rays(self.window, fine * height, fine * width)
        hit = scene.run(np.zeros_like(rays), rays, output=True)
        seen = hit["primID"] >= 0
        rays, face, u, v = rays[seen], hit["primID"][seen], hit["u"][seen, None], hit["v"][seen, None]

        albedo = np.broadcast_to(np.asarray(colours) ** SETTINGS.gamma, vertices.shape)
        corners = np.hstack([normals, albedo, light[:, None]]).astype(np.float32)[faces]
        a, b, c = (corners[face, corner] for corner in range(3))
        normal, albedo, light = np.split((1 - u - v) * a + u * b + v * c, [3, 6], axis=1)
        front = np.einsum("ij,ij->i", hit["Ng"][seen], rays) < 0
        if not smooth:
            normal = hit["Ng"][seen]
        # Both sides of a surface look the same. The face tells which side is visible: at a sharp edge the smooth normal
        # may point away from the viewer.
        normal = np.where(front[:, None], normal, -normal)

        picture = np.zeros((fine**2 * height * width, 4), dtype=np.float32)
        picture[seen, :3], picture[seen, 3] = _shade(normal, -rays, albedo, light), 1
        # Average the light instead of its encoding, weighted by coverage, so that outlines have no dark seam.
        picture = np.mean(
            [picture.reshape(height, fine, width, fine, 4)[:, i, :, j] for i in range(fine) for j in range(fine)],
            axis=0,
        )
        coverage = picture[..., 3:]
        picture[..., :3] = (picture[..., :3] / np.where(coverage > 0, coverage, 1)).clip(0, 1) ** (1 / SETTINGS.gamma)
        return (255 * picture + 0.5).astype(np.uint8)


@lru_cache(maxsize=4)
def _rays(window: tuple[float, float, float, float], height: int, width: int) -> NDArray[np.float32]:
    """Return directions (height·width, 3) through the pixels of a picture, row by row from the top."""
    left, right, bottom, top = window
    x = left + (right - left) * (np.arange(width) + 0.5) / width
    y = top - (top - bottom) * (np.arange(height) + 0.5) / height
    rays = np.stack([np.tile(x, height), np.repeat(y, width), np.full(height * width, -1.0)], axis=1)
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)


def _ambient(scene: object, vertices: FloatArray, normals: FloatArray) -> FloatArray:
    """Return the share (V,) of ambient light that reaches each vertex: creases and armpits are darker."""
    rays = SETTINGS.occlusion_rays
    k = np.arange(rays) + 0.5
    z, turn = 1 - 2 * k / rays, math.pi * (1 + math.sqrt(5)) * k  # evenly over the sphere (Fibonacci)
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
    """Return the linear light (n, 3) that leaves n points towards the viewer, in float32 for speed."""
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)
    low, high = SETTINGS.ambient
    light = ambient * (low + (high - low) * (0.5 + 0.5 * normal[:, 1:2]))
    gloss = 0.06 * (1 - np.einsum("ij,ij->i", normal, view)).clip(0, 1)[:, None] ** 3
    for direction, brightness in SETTINGS.lights:
        towards = (np.array(direction) / np.linalg.norm(direction)).astype(np.float32)
        diffuse = ((normal @ towards + SETTINGS.wrap) / (1 + SETTINGS.wrap)).clip(0)[:, None]
        light += brightness * diffuse * (0.4 + 0.6 * ambient)
        halfway = view + towards
        cosine = np.einsum("ij,ij->i", normal, halfway) / np.linalg.norm(halfway, axis=1)
        gloss += 0.08 * brightness * cosine.clip(0)[:, None] ** 40
    return albedo * light + gloss
