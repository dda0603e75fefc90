"""Columns of x, y and z in a table of points: by the names in its header, or by row numbers in front."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import MeshError

#: Words for the three axes in the names of columns.
_AXES = {
    **dict.fromkeys(("x", "easting", "east", "e", "rechtswert", "rechts", "ost", "est", "rw"), 0),
    **dict.fromkeys(("y", "northing", "north", "n", "hochwert", "hoch", "nord", "hw"), 1),
    **dict.fromkeys(("z", "elevation", "elev", "height", "altitude", "alt", "höhe", "hoehe", "h", "up"), 2),
}
#: Patterns of other words in these names: words for positions, units, and vectors that are no positions.
_POSITION = "pos|positions?|points?|pt|coords?|coordinates?|koord|koordinaten?|loc|location|vertex|p|c|wert|value"
_UNIT = "[mckunµμ]?m|in|inch|inches|ft|foot|feet|px|pixels?"
_OTHER = re.compile(
    "n|normals?|nrm|norm|dir|direction|vel|velocity|acc|rot|rotation|orient|orientation|error|err|std|sigma|var|"
    "colou?r|texture|tex|uv|tangent|gradient|force|gyro|offset|scale"
)
_BRACKETS = re.compile(r"[\[({][^\])}]*[\])}]")
_INDEX = re.compile(r"[\[(]\s*([xyz\d])\s*[\])]", re.IGNORECASE)
_REMARK_START = re.compile(r"[#/%!\s]*(?:(?:columns|fields)\s*[=:]\s*)?", re.IGNORECASE)
_GLUED = re.compile(rf"(?:{_POSITION})?([xyz])(\d*)(?:{_POSITION}|{_UNIT})?")
_WHOLE = re.compile(r"[+-]?\d+(?:[.,]0*)?")
#: Rows from which whole numbers that only go up are a sign of row numbers, whatever stands behind them.
_ENOUGH_ROWS = 5


def header_names(line: str, separator: str | None) -> list[str]:
    """Names of columns in a header whose columns have a separator; None for blanks."""
    line = _REMARK_START.sub("", line, count=1)
    if separator is None:
        line = _BRACKETS.sub("", _INDEX.sub(r"_\1", line))
    parts = re.split(r"[\s,;]+" if separator is None else re.escape(separator), line.strip())
    return [part.strip("\"' \t") for part in parts]


def named_columns(names: Sequence[str]) -> tuple[int, int, int] | None:
    """Columns that a header names x, y and z; None if it names none so.

    Plain names come first, then names such as "Position X" or "x_mm", then names with other words. Words such as
    "northing" or "height" count only where x, y and z are not all there.

    Raises:
        MeshError: two sets of columns have such names.
    """
    for axes in ({"x": 0, "y": 1, "z": 2}, _AXES):
        ranks: list[dict[frozenset[str], dict[int, list[int]]]] = [{}, {}, {}]
        for column, name in enumerate(names):
            if found := _axis(name, axes):
                axis, rank, words = found
                ranks[rank].setdefault(words, defaultdict(list))[axis].append(column)
        for sets in ranks:
            complete = [columns for columns in sets.values() if len(columns) == 3]
            if len(complete) > 1 or any(len(columns) > 1 for one in complete for columns in one.values()):
                raise MeshError("its header names two sets of columns x, y and z: keep one of them")
            if complete:
                return complete[0][0][0], complete[0][1][0], complete[0][2][0]
    return None


def _axis(name: str, axes: Mapping[str, int]) -> tuple[int, int, frozenset[str]] | None:
    """The axis that a name tells, its rank from plain to unusual, and other words in it."""
    bare = re.sub(r"(?<=[a-zß-ÿ])(?=[A-Z])", " ", _BRACKETS.sub("", _INDEX.sub(r"_\1", name))).lower()
    words = [word for word in re.split(r"[\s_:./\-]+", bare) if word]
    words = [word for word in words if not re.fullmatch(_UNIT, word)] or words
    letters = [word for word in words if word in ("x", "y", "z")] or [word for word in words if word in axes]
    if len(letters) == 1:
        axis = axes[letters[0]]
        # "X East" is x, and "normal n" has other words.
        words = [word for word in words if word not in letters and (word == "n" or word not in _AXES)]
    elif words and words[-1] in ("0", "1", "2") and any(re.fullmatch(_POSITION, word) for word in words):
        axis, words = int(words[-1]), words[:-1]
    elif len(words) == 1 and (glued := _GLUED.fullmatch(words[0])):
        axis, words = axes[glued[1]], ["point", glued[2]] if glued[2] else ["point"]
    else:
        return None
    if any(map(_OTHER.fullmatch, words)):
        return None
    others = frozenset(word for word in words if not re.fullmatch(_POSITION, word))
    return axis, 2 if others else 1 if words else 0, others


def row_numbers(rows: Sequence[Sequence[str]], start: int, where: str) -> int:
    """Number of columns with row numbers in front of the coordinates, from column ``start`` of rows of text.

    The message of an error starts with ``where``, the number of the first line.

    Raises:
        MeshError: the first columns may be row numbers or coordinates.
    """
    width = min(map(len, rows)) - start
    if width < 4 or len(rows) < 2:
        return 0
    columns = [[row[start + k] for row in rows] for k in range(min(width, 5))]
    whole = [all(map(_WHOLE.fullmatch, column)) for column in columns]
    in_front = whole.index(False) if False in whole else len(whole)
    if not in_front:
        return 0
    first = np.array([value.replace(",", ".") for value in columns[0]], np.float64)
    if in_front > 2 or in_front + 3 > len(columns) or any(whole[in_front : in_front + 3]):
        # No three columns with fractions follow.
        if (np.diff(first) == 1).all():
            return 1
        if len(rows) < _ENOUGH_ROWS or np.ptp(np.sign(np.diff(first))) or first[0] == first[1]:
            return 0
    elif in_front == 1 and uncounted(first) is None:
        return 1
    elif in_front == 2:
        second = np.array([value.replace(",", ".") for value in columns[1]], np.float64)
        if all(len(set(np.sign(np.diff(values)))) == 1 and values[0] != values[1] for values in (first, second)):
            return 2
    raise MeshError(
        f"{where} can begin with x, y and z, or with a row number: delete the row numbers, or write a first line that "
        "names each column, with x, y and z"
    )


def uncounted(numbers: FloatArray) -> int | None:
    """The first place where numbers are no row numbers; None if they are.

    Row numbers are whole. They go up or down all the time, or start again from the first number, in blocks.
    """
    steps = np.diff(numbers)
    upward = np.sign(steps[0])
    wrong = (np.sign(steps) != upward) & (numbers[1:] != numbers[0])
    # A block has at least two rows.
    restarts = (numbers[1:] == numbers[0]) & np.append(np.sign(steps[1:]) != upward, False)
    wrong |= restarts | (numbers[1:] != np.round(numbers[1:])) | (upward == 0)
    return int(np.flatnonzero(wrong)[0]) + 1 if wrong.any() else None
