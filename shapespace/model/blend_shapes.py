"""A model as linear blend shapes, for programs that know sliders and no networks; and how far that is from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.blend_shapes import blend_shapes_glb
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.rigid_motion import align
from shapespace.model.decoder import Decoder, MeshChoice, Shape
from shapespace.model.latent_space import Codes, Distribution

#: Random codes by which blend shapes are measured.
MEASURED = 40


class PeriodicError(ValueError):
    """A model with angles among its coordinates, which have no ends."""


@dataclass(frozen=True)
class BlendShapes:
    """A shape, and for each coordinate those at both of its bounds.

    Attributes:
        rest: (V, 3) of code 0, aligned to the reference, in the units of the training meshes.
        ends: (2m, V, 3) of the codes in which one coordinate is at its upper or at its lower bound and all others 0,
            aligned to the shape at rest.
        names: (2m,), the coordinates' with + or -.
        faces: (F, 3).
        surface: of the mesh, where its file had more than triangles.
        error: ``mean`` and ``p95`` over vertices and random codes inside the bounds, of the distance of the linear
            blend to the model's shape, as shares of the diagonal of the reference.
        model: name and version.
    """

    rest: FloatArray
    ends: FloatArray
    names: list[str]
    faces: IntArray
    surface: MeshAttributes | None
    error: dict[str, float]
    model: str

    def glb(self) -> bytes:
        """A GLB with a morph target for each end, and the error in ``asset.extras``."""
        extras = {"model": self.model, "error": self.error}
        return blend_shapes_glb(self.rest, self.ends, self.names, self.faces, self.surface, extras)


def require_ends(model: Decoder) -> None:
    """Raise PeriodicError for a model with angles among its coordinates."""
    angles = [name for name, period in zip(model.latents.names, model.manifest.period, strict=True) if period]
    if angles:
        raise PeriodicError(
            f"{model.manifest.name} has angles among its coordinates ({angles[0]}), which have no ends to blend "
            "between. Ask for shapes of codes, or for an animation."
        )


def blend_shapes(model: Decoder, mesh: MeshChoice, shape: Callable[[Codes], Shape]) -> BlendShapes:
    """The blend shapes of a model.

    Args:
        model: without angles.
        mesh: fine or coarse.
        shape: of a code (m,), on that mesh.

    Raises:
        PeriodicError: a model with angles.
        NotFiniteError, ModelFailedError: the model has no shape for a code.
    """
    require_ends(model)
    latents, m = model.latents, model.latents.dimension
    rest = shape(np.zeros(m, np.float32)).vertices
    sides = np.stack([latents.upper, latents.lower], axis=1).ravel()
    codes = (np.repeat(np.eye(m), 2, axis=0) * sides[:, None]).astype(np.float32)
    ends = align(np.stack([shape(code).vertices for code in codes]), rest)
    size, away = model.manifest.scale * model.mesh(mesh).diagonal, []
    for code in latents.sample(MEASURED, 0, Distribution.UNIFORM):
        # How far along a coordinate is, of the way to the bound on its side.
        along = np.repeat(code.astype(np.float64), 2) / np.where(sides == 0, 1, sides)
        weights = np.where((sides == 0) | (along < 0), 0, along)
        blend = rest + np.tensordot(weights, ends - rest, 1)
        away.append(np.linalg.norm(align(shape(code).vertices, blend) - blend, axis=1) / size)
    return BlendShapes(
        rest,
        ends,
        [f"{name} {sign}" for name in latents.names for sign in "+-"],
        model.mesh(mesh).faces,
        model.surface(mesh),
        {"mean": float(np.mean(away)), "p95": float(np.percentile(away, 95))},
        f"{model.manifest.name}/{model.manifest.version}",
    )
