"""``?place=``: placement of an answered mesh."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import Depends, Query
from pydantic import Field, TypeAdapter, model_validator

from shapespace.mesh.rigid_motion import Placement
from shapespace.service.http.messages.json_query import read_query
from shapespace.service.use_cases.fields import Body, Number

#: Tolerance of the products of a rotation's rows, which should be 0 or 1.
_ROUNDING = 1e-3
_EXAMPLE = '{"rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "translation": [0, 0, 2], "scale": 1}'
_Three = Annotated[list[Number], Field(min_length=3, max_length=3, fail_fast=True)]


class _PlacementRequest(Body):
    """Placement in the form that ``edit`` and ``fit`` answer."""

    rotation: Annotated[list[_Three], Field(min_length=3, max_length=3, fail_fast=True)] = Field(
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    )
    translation: _Three = Field([0, 0, 0])
    scale: Number = Field(1, gt=0)

    @model_validator(mode="after")
    def _turns(self) -> _PlacementRequest:
        matrix = np.array(self.rotation)
        largest = np.abs(matrix).max()
        if not (largest < 2 and np.abs(matrix @ matrix.T - np.eye(3)).max() < _ROUNDING and np.linalg.det(matrix) > 0):
            raise ValueError("rotation is none: its rows must be orthogonal, of length 1, and without a reflection")
        return self


_ADAPTER = TypeAdapter(_PlacementRequest)


async def _query(
    place: Annotated[
        str | None,
        Query(
            description="Answer the mesh elsewhere: a placement as JSON, as `edit` and `fit` answer it: it takes x to "
            "`scale` · `rotation` · x + `translation`. Members left out change nothing.",
            openapi_examples={"a quarter turn": {"value": _EXAMPLE}},
        ),
    ] = None,
) -> Placement | None:
    if place is None:
        return None
    given = read_query(place, "place", _ADAPTER)
    return Placement(np.array(given.rotation, float), np.array(given.translation, float), given.scale)


PlaceQuery = Annotated[Placement | None, Depends(_query)]
