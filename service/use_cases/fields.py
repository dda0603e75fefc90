"""Types of numbers and objects in JSON, and of numbers in queries, checked strictly."""

from __future__ import annotations

import math
import re
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
#: A whole number. JSON has one type for all numbers, so 3.0 is accepted as 3.
Whole = Annotated[
    int,
    Field(strict=True),
    BeforeValidator(lambda given: int(given) if isinstance(given, float) and given.is_integer() else given),
]
#: Numbers in queries and forms, in the same spelling for all. Python would accept 1_000 too.
DIGITS = BeforeValidator(lambda given: given.replace("_", "?") if isinstance(given, str) else given)
WholeText = Annotated[int, DIGITS]
NumberText = Annotated[Annotated[float, Field(allow_inf_nan=False)] | None, DIGITS]
#: An index in digits, without zeros in front: two spellings would name one coordinate twice.
_INDEX = "0|[1-9][0-9]{0,5}"


def _by_index(given: object) -> object:
    # Stops at the first fault: every member may have a fault.
    if isinstance(given, dict):
        for index, value in given.items():
            if not re.fullmatch(_INDEX, str(index)):
                raise ValueError(f'{str(index)[:20]!r} is not an index; send numbers by index, as in {{"3": 0.5}}')
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ValueError(f"the value at {index} is not a finite number")
    return given


#: Numbers by index. JSON objects have strings as names, so an index is written in digits.
NumbersByIndex = Annotated[
    dict[int, float],
    BeforeValidator(_by_index),
    Field(json_schema_extra={"propertyNames": {"pattern": f"^({_INDEX})$"}}),
]
#: Maximum number of members of an object, because each unknown member is reported.
_MEMBERS = 32


class Body(BaseModel):
    """Body of a request, or an object in a body."""

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _of_few_members(cls, given: object) -> object:
        if isinstance(given, dict) and len(given) > _MEMBERS:
            raise ValueError(f"it has {len(given)} members; /openapi.json lists the possible ones")
        return given
