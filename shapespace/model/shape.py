"""A decoded shape: its quality, its diagnostics, and its vertices."""

from dataclasses import dataclass, field

from shapespace.arrays import FloatArray
from shapespace.model.choice import Choice
from shapespace.solve.outcome import Status


class Quality(Choice):
    """Accuracy of a shape.

    ``full``: Gauss–Newton until no vertex moves. ``draft``: from face frames alone, in a fraction of the time.
    ``auto``: the draft, improved by the few Gauss–Newton steps that bring it closer to the exact shape, or as it is if
    the model's ``auto_error`` says that drafts with its misfit are close enough. The remaining
    steps of ``full`` are smaller than the error of the networks.
    """

    AUTO = "auto"
    FULL = "full"
    DRAFT = "draft"


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of a decoded shape.

    Attributes:
        status: how Gauss–Newton ended; ``converged`` for a draft, which needs no Gauss–Newton.
        iterations: number of Gauss–Newton steps.
        residual: relative difference of the shape's lengths and angles from the networks' prediction, in the weighted
            norm.
        flipped_faces: number of faces at an edge whose dihedral angle differs by more than π/2 from the prediction.
        integrability: distance of the prediction from the lengths and angles of any surface: root mean square over
            vertices of ``|Q(z)|``, the sine of half the angle by which faces around a vertex fail to close.
        plausibility: distance from the nearest training code, in multiples of the typical distance between training
            codes; None if the model has no training codes.
        inside_bounds: whether the code lies inside the model's bounds.
        model: digest of the model's manifest.
        quality: quality that was answered: ``full`` where a draft would have been bad, and for ``auto`` if the bundle
            does not say how many steps are enough.
    """

    status: Status
    iterations: int
    residual: float
    flipped_faces: int
    integrability: float
    plausibility: float | None
    inside_bounds: bool
    model: str
    quality: Quality = Quality.FULL


@dataclass(frozen=True)
class Shape:
    """Decoded shape, aligned to the reference, in the units of the training meshes.

    Attributes:
        vertices: (V, 3) vertices of the requested mesh.
        diagnostics: diagnostics, which concern the coarse mesh.
        seconds: time in seconds by stage, ``network`` and ``reconstruct``.
    """

    vertices: FloatArray
    diagnostics: Diagnostics
    seconds: dict[str, float] = field(compare=False)
