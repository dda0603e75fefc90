"""A drawing of a mesh as SVG, for places where nothing else can draw it yet."""

from __future__ import annotations

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh, face_normals

#: Directions from the mesh to the camera, as in the page (js/view/scene.js), and to the light.
_CAMERA, _LIGHT = np.array([0.45, 0.28, 1.0]), np.array([-0.5, 0.9, 1.0])
#: Colours of clay in the light and in the shade, and the number of steps between them.
_BRIGHT, _DARK, _STEPS = np.array([236, 218, 201]), np.array([92, 80, 72]), 24
#: Height of the drawing in its own units: faces are about ten units wide.
_HEIGHT = 600
#: Units by which the corners of a face reach over its neighbours, which closes the gaps of anti-aliasing. A stroke
#: would do it too, but takes a browser without graphics hardware several times as long.
_OVERLAP = 1.2


def poster(mesh: TriangleMesh) -> bytes:
    """Return a shaded drawing of a mesh (y up) as SVG: the faces that face the camera, from back to front.

    It has no perspective, and no shadows of one part on another.
    """
    across, up, forward = _axes(_CAMERA)
    vertices = mesh.vertices
    plane = np.stack([vertices @ across, -vertices @ up], axis=1)
    low, high = plane.min(axis=0), plane.max(axis=0)
    scale = _HEIGHT / max(*(high - low), np.finfo(float).tiny)
    normals = face_normals(vertices, mesh.faces)
    towards = np.flatnonzero(normals @ forward > 0)
    depth = (vertices @ forward)[mesh.faces[towards]].mean(axis=1)
    ordered = towards[np.argsort(depth, kind="stable")]
    corners = ((plane - low) * scale)[mesh.faces[ordered]]
    outwards = corners - corners.mean(axis=1, keepdims=True)
    reach = np.maximum(np.linalg.norm(outwards, axis=2, keepdims=True), np.finfo(float).tiny)
    points = np.rint(corners + _OVERLAP * outwards / reach).astype(int)
    light = np.clip(normals[ordered] @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    shade = np.rint(np.rint(light * _STEPS)[:, None] / _STEPS * (_BRIGHT - _DARK) + _DARK).astype(int)
    width, height = np.rint((high - low) * scale).astype(int)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-2 -2 {width + 4} {height + 4}">'
    paths = (
        f'<path fill="{colour}" d="M{a[0]} {a[1]}L{b[0]} {b[1]} {c[0]} {c[1]}z"/>'
        for (a, b, c), colour in zip(
            points.tolist(), (f"#{r:02x}{g:02x}{b:02x}" for r, g, b in shade.tolist()), strict=True
        )
    )
    return "".join([head, *paths, "</svg>\n"]).encode()


def _axes(towards: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the picture's axes (3,) to the right and upwards, and the direction to the camera."""
    forward = towards / np.linalg.norm(towards)
    across = np.cross([0.0, 1.0, 0.0], forward)
    across /= np.linalg.norm(across)
    return across, np.cross(forward, across), forward
