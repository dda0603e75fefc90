"""Linear blend shapes of a model, for programs without networks, and their error against the model."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.animated_gltf import blend_shapes_glb
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.rigid_motion import align
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.latent_space import Codes, Distribution
from shapespace.model.shape import Shape

#: Number of random codes by which the error is measured.
MEASURED = 40


class PeriodicError(ValueError):
    """A model with angles among its coordinates, which have no ends."""


@dataclass(frozen=True)
class BlendShapes:
    """The shape of code 0, and the shapes at both bounds of each coordinate.

    Attributes:
        rest: (V, 3) shape of code 0, aligned to the reference, in the units of the training meshes.
        ends: (2m, V, 3) shapes with one coordinate at its upper or lower bound and all other coordinates 0, aligned to
            ``rest``.
        names: (2m,) names of the coordinates with + or -.
        faces: (F, 3) faces.
        surface: attributes of the training file's mesh, if it had more than triangles.
        error: ``mean`` and ``p95`` of the distance between linear blend and model, over vertices and random codes
            inside the bounds, as shares of the reference's diagonal.
        model: name and version of the model.
    """

    rest: FloatArray
    ends: FloatArray
    names: list[str]
    faces: IntArray
    surface: MeshAttributes | None
    error: dict[str, float]
    model: str

    def glb(self) -> bytes:
        """Return a GLB with a morph target for each end, and with the error in ``asset.extras``."""
        extras = {"model": self.model, "error": self.error}
        return blend_shapes_glb(self.rest, self.ends, self.names, self.faces, self.surface, extras)


def require_ends(model: Decoder) -> None:
    """Raise PeriodicError if the model has angles among its coordinates."""
    angles = [name for name, period in zip(model.latents.names, model.manifest.period, strict=True) if period]
    if angles:
        raise PeriodicError(
            f"{model.manifest.name} has angles among its coordinates ({angles[0]}), which have no bounds to blend "
            "between. Ask for shapes of codes, or for an animation."
        )


def blend_shapes(model: Decoder, mesh: MeshChoice, shape: Callable[[Codes], Shape]) -> BlendShapes:
    """Compute the blend shapes of a model.

    ``shape`` computes the shape of a code (m,) on this mesh. Raises PeriodicError if the model has angles, and
    NotFiniteError or ModelFailedError if it has no shape for a code.
    """
    require_ends(model)
    latents, m = model.latents, model.latents.dimension
    rest = shape(np.zeros(m, np.float32)).vertices
    sides = np.stack([latents.upper, latents.lower], axis=1).ravel()
    codes = (np.repeat(np.eye(m), 2, axis=0) * sides[:, None]).astype(np.float32)
    ends = align(np.stack([shape(code).vertices for code in codes]), rest)
    size, away = model.manifest.scale * model.mesh(mesh).diagonal, []
    for code in latents.sample(MEASURED, 0, Distribution.UNIFORM):
        # Position of each coordinate between 0 and the bound on its side.
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
