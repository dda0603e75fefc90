"""Numbers and objects as JSON holds them, checked strictly."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
#: JSON knows one kind of number only, where 3.0 is as whole as 3.
Whole = Annotated[
    int,
    Field(strict=True),
    BeforeValidator(lambda given: int(given) if isinstance(given, float) and given.is_integer() else given),
]
#: Members that an object may have: each unknown one is a fault.
_MEMBERS = 32


class Body(BaseModel):
    """A body of a request, or an object in it."""

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _of_few_members(cls, given: object) -> object:
        if isinstance(given, dict) and len(given) > _MEMBERS:
            raise ValueError(f"it has {len(given)} members; /openapi.json lists those there are")
        return given
