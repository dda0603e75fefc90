"""``?color=`` and ``?against=``: colouring a mesh by how it differs from another shape of its model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Query, Request

from shapespace.files.colouring import Quantity
from shapespace.model.latent_space import Bounds, CheckedCode, LatentSpace
from shapespace.service.http.negotiation import choose
from shapespace.service.http.problems import ProblemError
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS

_NUMBER = r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?"
#: What the description says of numbers in a query.
NUMBERS = f"^{_NUMBER}(,{_NUMBER})*$"
#: Why a format isn't among those of a coloured mesh.
_UNCOLOURED = {
    name: f"{name.upper()} files can't carry colours" for name, format in SHAPE_FORMATS.items() if not format.coloured
}


@dataclass(frozen=True)
class Comparison:
    """What to colour a mesh by.

    Attributes:
        quantity: stretch or bending.
        code: of the other shape, (m,) and whether it is inside the bounds; None is the reference.
    """

    quantity: Quantity
    code: CheckedCode | None

    @property
    def key(self) -> tuple[str, bytes]:
        """All that the colours depend on besides the shape."""
        return self.quantity, b"" if self.code is None else self.code[0].tobytes()


@dataclass(frozen=True)
class ComparisonQuery:
    """The same, as it stands in the address."""

    quantity: Quantity | None
    against: list[float] | None

    def on(self, latents: LatentSpace, bounds: Bounds = Bounds.ALLOW) -> Comparison | None:
        """With the other code checked as the first one is; raises LatentError."""
        if self.quantity is None:
            return None
        if self.against is None:
            return Comparison(self.quantity, None)
        return Comparison(self.quantity, latents.code(self.against, bounds))


def numbers(text: str, name: str) -> list[float]:
    """A code in a query; raises ProblemError, invalid-request."""
    try:
        if "_" in text or not text.isascii():  # Python reads more as a number than others
            raise ValueError
        return [float(part) for part in text.split(",")] if text else []
    except ValueError:
        raise ProblemError(
            "invalid-request", f"{name} is not a list of numbers. Send them separated by commas: ?{name}=0.1,0.2"
        ) from None


async def _query(
    color: Annotated[
        Quantity | None,
        Query(
            description="Colour the vertices by how their edges differ from the other shape's: `stretch` is the "
            "logarithm of the lengths' ratio, `bending` the change of the dihedral angles in radians. Every format but "
            "STL carries colours; NPZ and JSON carry the values."
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
) -> ComparisonQuery:
    if against is not None and color is None:
        raise ProblemError("invalid-request", "against says what colours compare with. Add color=stretch or bending.")
    return ComparisonQuery(color, None if against is None else numbers(against, "against"))


ColorQuery = Annotated[ComparisonQuery, Depends(_query)]
NO_COLOR = ComparisonQuery(None, None)


def choose_mesh(format: str | None, request: Request, color: ComparisonQuery) -> str:
    """The format of a mesh answer, which carries colours where some are asked for; raises ProblemError."""
    formats = {name: f.media_type for name, f in SHAPE_FORMATS.items() if f.coloured or color.quantity is None}
    return choose(formats, format, request.headers.get("accept"), _UNCOLOURED)
