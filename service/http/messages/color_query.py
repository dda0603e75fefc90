"""``?color=`` and ``?against=``: colours of a mesh by its difference from another shape of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Query, Request

from shapespace.files.colouring import Quantity
from shapespace.model.latent_space import Bounds
from shapespace.model.shape_model import ShapeModel
from shapespace.model.vertex_uncertainty import require_covariance
from shapespace.service.http.messages.latent_query import NUMBERS, numbers
from shapespace.service.http.negotiation import choose
from shapespace.service.http.problems import ProblemError
from shapespace.service.use_cases.one_shape import ColourOptions
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS, UNAVAILABLE, writable

#: Reasons why formats can't hold a coloured mesh.
_UNCOLOURED = {
    name: f"{name.upper()} files can't carry colours" for name, format in SHAPE_FORMATS.items() if not format.coloured
}


@dataclass(frozen=True)
class ColourParameters:
    """Values of ``?color=`` and ``?against=``."""

    quantity: Quantity | None
    against: list[float] | None

    def on(
        self, model: ShapeModel, bounds: Bounds = Bounds.ALLOW, covariance: Sequence[Sequence[float]] | None = None
    ) -> ColourOptions | None:
        """Return the colouring, with the other code checked like the first; raises LatentError or ProblemError."""
        if self.quantity is Quantity.SPREAD:
            if covariance is None:
                raise ProblemError(
                    "invalid-request", "color=spread shows how sure a code is. POST it with its covariance in the body."
                )
            return ColourOptions(self.quantity, None, require_covariance(model.decoder, covariance))
        if covariance is not None:
            raise ProblemError("invalid-request", "covariance is what color=spread shows. Add ?color=spread.")
        if self.quantity is None:
            return None
        return ColourOptions(self.quantity, None if self.against is None else model.latents.code(self.against, bounds))


async def _query(
    color: Annotated[
        Quantity | None,
        Query(
            description="Colour the vertices by how their edges differ from the other shape's: `stretch` is the "
            "logarithm of the lengths' ratio, `bending` the change of the dihedral angles in radians. Or by `spread`, "
            "the standard deviation of each vertex by the `covariance` in the body of a POST. Every format but STL "
            "carries colours; NPZ and JSON carry the values."
        ),
    ] = None,
    against: Annotated[
        str | None,
        Query(
            description="With `color`: code of the other shape, coordinates separated by commas; without it the "
            "reference.",
            openapi_examples={"a code": {"value": "0,0,0,0"}},
            json_schema_extra={"pattern": NUMBERS},
        ),
    ] = None,
) -> ColourParameters:
    if against is not None and color in (None, Quantity.SPREAD):
        raise ProblemError("invalid-request", "against says what colours compare with. Add color=stretch or bending.")
    return ColourParameters(color, None if against is None else numbers(against, "against"))


ColorQuery = Annotated[ColourParameters, Depends(_query)]
NO_COLOR = ColourParameters(None, None)


def choose_mesh(format: str | None, request: Request, color: ColourParameters) -> str:
    """Return the format of a mesh answer, with colours if requested; raises ProblemError."""
    formats = {name: f.media_type for name, f in SHAPE_FORMATS.items() if f.coloured or color.quantity is None}
    return choose(writable(formats), format, request.headers.get("accept"), _UNCOLOURED | UNAVAILABLE)
