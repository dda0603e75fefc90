"""Values that pydantic refuses, in words: what a setting, an option or a member of a request needs instead."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

#: Type of a fault: a member that does not exist. Its name is what was given, and may look like a type.
UNKNOWN = "extra_forbidden"

#: What a value has to be, by the type of pydantic's fault; `{…}` is a member of the fault's context.
WANTED = {
    "list_type": "a list",
    "dict_type": "an object",
    "too_short": "{min_length} or more entries",
    "too_long": "{max_length} or fewer entries",
    "string_type": "a text",
    "string_too_short": "{min_length} or more characters",
    "string_too_long": "at most {max_length} characters",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than_equal": "a number of at most {le}",
    "less_than": "a number below {lt}",
    "finite_number": "a finite number",
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("int_type", "int_from_float", "int_parsing"), "a whole number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    "union_tag_invalid": "a {discriminator} among {expected_tags}",
    **dict.fromkeys(("enum", "literal_error"), "{expected}"),
}
#: Name of a type in the place of a fault: pydantic names which member of a union it tried.
_TYPE = re.compile(r"[a-z-]+\[.*\]|(constrained-)?(bool|float|int|str)|[A-Z][a-z]\w*")


def in_short(faults: Iterable[Mapping[str, Any]], words: Mapping[str, str]) -> list[str]:
    """Return a line for each place with faults: what it is called, and what it needs.

    Args:
        faults: of a `ValidationError`. Their own ``words``, if any, are said.
        words: sentences for types of faults that pydantic says too technically.
    """
    wanted: dict[str, list[str]] = {}
    said: dict[str, str] = {}
    for fault in faults:
        place = _place(fault)
        if fault["type"] in WANTED:
            wanted.setdefault(place, []).append(WANTED[fault["type"]].format(**fault.get("ctx", {})))
        elif fault["type"] == "missing":
            said[place] = "is not there; add it"
        else:
            message = fault["msg"].removeprefix("Value error, ")
            said.setdefault(place, fault.get("words") or words.get(fault["type"], message))
    said |= {place: f"needs {' or '.join(dict.fromkeys(kinds))}" for place, kinds in wanted.items()}
    # Where a union has another member, the deeper fault is the one that was meant.
    meant = [place for place in said if not any(other.startswith(f"{place}.") for other in said if place)]
    return [": ".join(filter(None, (place, said[place]))) for place in meant]


def _place(fault: Mapping[str, Any]) -> str:
    """Return the members and indices that lead to a fault, without names of types."""
    parts = [str(part) for part in fault["loc"]]
    if parts[-1:] == ["[key]"]:
        return f"the key {parts[-2]}"
    kept = len(parts) if fault["type"] != UNKNOWN else len(parts) - 1
    return ".".join([*(part for part in parts[:kept] if not _TYPE.fullmatch(part)), *parts[kept:]])
