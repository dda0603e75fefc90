"""Point clouds as text: XYZ, PTS, CSV and TXT in the dialects of scanners, spreadsheets and ParaView.

Such a file does not name its dialect. `_Dialect.of` finds it in the first lines: the separator of columns, a decimal
comma, and the columns of x, y and z. A file that can be read in two ways is refused, and the message shows both.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, as_utf8, quoted
from shapespace.mesh.triangle_mesh import MeshError

#: Lines with points in which the dialect is looked for, and lines that may stand before the first point.
_LOOK, _MOST_HEADER = 400, 100
#: Characters of a line.
_LONGEST_LINE = 2**16
_LINE = re.compile(r"[^\s][^\r\n]*")
_REMARK = re.compile(r"#|//|%|!")
_WHOLE = re.compile(r"[+-]?\d+")
_POINT_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf)", re.IGNORECASE)
_COMMA_NUMBER = re.compile(r"[+-]?(?:\d+(?:,\d*)?|,\d+)(?:e[+-]?\d+)?", re.IGNORECASE)
#: Names of the coordinates in a header: usual ones, and those of ParaView.
_AXES = (("x", "y", "z"), ("points:0", "points:1", "points:2"), ("points_0", "points_1", "points_2"))
_UNIT = re.compile(r"\s*[\[(][^\])]*[\])]")


def read_point_text(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Points (N, 3) of a text with one point a line, and no faces.

    Columns are separated by blanks, tabs, commas or semicolons. Remarks, a header, a line with the number of points, a
    running number in front, and normals or colours behind the coordinates are left out.

    Raises:
        MeshError: the text can be read in two ways, or has more points than the limits allow.
        ValueError: a line is no point; the message shows the line.
    """
    text = str(as_utf8(data), "utf-8", "replace")
    if "\0" in text[:1000] or "\ufffd" in text[:100]:
        raise ValueError("it is not text")
    points, counts = _Dialect.of(text).read(text)
    limits.check(len(points), 0)
    if counts and sum(counts) != len(points):
        raise ValueError(f"it should have {sum(counts)} points, but has {len(points)}")
    return points, np.zeros((0, 3), np.int64)


@dataclass(frozen=True)
class _Dialect:
    """How the points are written.

    Attributes:
        separator: of columns; None for blanks and tabs, ", " for a comma that a blank follows.
        decimal_comma: whether decimals have a comma.
        columns: of x, y and z.
        numbered: whether column 0 is a running number.
        header: lines before the first point that are neither a remark nor a number of points.
    """

    separator: str | None
    decimal_comma: bool
    columns: tuple[int, int, int] = (0, 1, 2)
    numbered: bool = False
    header: int = 0

    @classmethod
    def of(cls, text: str) -> _Dialect:
        """Find the dialect of a text."""
        names: list[str] = []
        sample: list[tuple[int, str]] = []
        header = 0
        for place, line in _lines(text):
            if len(sample) == _LOOK or header > _MOST_HEADER:
                break
            if _is_point(line):
                sample.append((place, line))
            elif not _is_beside(line):
                if sample:
                    raise _fault(text, place, line)
                header, names = header + 1, _names(line)
            elif not sample and _REMARK.match(line):
                names = _names(line)
        if not sample:
            raise _fault(text, *next(_lines(text), (0, "")))
        found = replace(cls._separation(text, sample, len(names)), header=header)
        return found._with_columns([found.split(line) for _, line in sample], names)

    @classmethod
    def _separation(cls, text: str, sample: list[tuple[int, str]], named: int) -> _Dialect:
        """The separator and the decimals of sample lines, beside a header with some number of names."""
        joined = "".join(line for _, line in sample)
        candidates = [cls(";", True), cls(";", False)] if ";" in joined else []
        candidates += [cls(", ", True), cls(None, True), cls(",", False)] if "," in joined else [cls(None, False)]
        found = next((one for one in candidates if all(one.fits(line) for _, line in sample)), None)
        if found is None:
            wrong = (row for row in sample if not any(one.fits(row[1]) for one in candidates))
            raise _fault(text, *next(wrong, sample[0]))
        values = sample[0][1].split(",")
        if found == cls(",", False) and named != len(values) and all(_may_be_decimals(line) for _, line in sample):
            other = [f"{whole}.{part}" for whole, part in zip(values[::2], values[1::2], strict=True)]
            raise MeshError(
                f"line {_number(text, sample[0][0])}, {quoted(sample[0][1])}, can be read as "
                f"({', '.join(values[:3])}) and as ({', '.join(other[:3])}): write decimals with a point, or separate "
                "columns by semicolons"
            )
        return found

    def _with_columns(self, rows: list[list[str]], names: list[str]) -> _Dialect:
        for axes in _AXES:
            if len(names) == len(rows[0]) and set(axes) <= set(names):
                x, y, z = map(names.index, axes)
                return replace(self, columns=(x, y, z))
        first = [row[0] for row in rows]
        counting = min(map(len, rows)) > 3 and len(rows) > 1 and all(map(_WHOLE.fullmatch, first))
        if counting and _counts_up(np.array(first, np.float64)):
            return replace(self, columns=(1, 2, 3), numbered=True)
        return self

    def split(self, line: str) -> list[str]:
        """The columns of a line."""
        if self.separator == ", ":
            return re.split(r",\s+", line.rstrip(", "))
        return [value.strip(' \t"') for value in line.split(self.separator)]

    def fits(self, line: str) -> bool:
        """Whether the coordinates in a line are numbers as this dialect writes them."""
        values = self.split(line)
        number = _COMMA_NUMBER if self.decimal_comma else _POINT_NUMBER
        if len(values) <= max(self.columns) or not all(number.fullmatch(values[k]) for k in self.columns):
            return False
        # Without a decimal comma it is an ordinary comma with a blank behind it.
        return self.separator != ", " or any("," in values[k] for k in self.columns)

    def read(self, text: str) -> tuple[FloatArray, list[int]]:
        """All points (N, 3), and the numbers of points that the text states."""
        counts: list[int] = []

        def rows() -> Iterator[str]:
            for _, line in self._rows(text, counts):
                values = line.partition("#")[0].replace('"', "")
                if self.separator == ", ":
                    values = re.sub(r",\s+", " ", values.rstrip(", "))
                yield values.replace(",", ".") if self.decimal_comma else values

        separator = None if self.separator == ", " else self.separator
        wanted = (0, *self.columns) if self.numbered else self.columns
        try:
            found = np.loadtxt(rows(), np.float64, comments=None, delimiter=separator, usecols=wanted, ndmin=2)
        except ValueError:
            wrong = next((row for row in self._rows(text, []) if not self.fits(row[1])), None)
            if wrong is None:
                raise
            raise _fault(text, *wrong) from None
        if self.numbered and not _counts_up(found[:, 0]):
            k = int(np.flatnonzero(np.diff(found[:, 0]) != 1)[0]) + 1
            place, line = next(islice(self._rows(text, []), k, None))
            raise ValueError(
                f"its first column counts the points, but not in line {_number(text, place)}, {quoted(line)}"
            )
        return found[:, 1:].copy() if self.numbered else found, counts

    def _rows(self, text: str, counts: list[int]) -> Iterator[tuple[int, str]]:
        """The lines with points; numbers of points are added to ``counts``."""
        header = self.header
        for place, line in _lines(text):
            if _WHOLE.fullmatch(line):
                counts.append(int(line))
            elif not _REMARK.match(line):
                if header:
                    header -= 1
                else:
                    yield place, line


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines that are not blank, without blanks at their ends, each with the place in the text where it starts."""
    for match in _LINE.finditer(text):
        if match.end() - match.start() > _LONGEST_LINE:
            raise MeshError(f"line {_number(text, match.start())} has more than {_LONGEST_LINE} characters")
        yield match.start(), match[0].rstrip()


def _number(text: str, place: int) -> int:
    """Number of the line at a place in the text, from 1."""
    return 1 + max(text.count("\n", 0, place), text.count("\r", 0, place))


def _is_point(line: str) -> bool:
    """Whether a line starts with three numbers, however they are separated."""
    values = re.split(r"[\s,;]+", line.replace('"', ""), maxsplit=3)[:3]
    return len(values) == 3 and all(map(_POINT_NUMBER.fullmatch, values))


def _is_beside(line: str) -> bool:
    """Whether a line is a remark or a number of points."""
    return bool(_REMARK.match(line) or _WHOLE.fullmatch(line))


def _names(line: str) -> list[str]:
    """Names of columns in a header, in small letters and without units."""
    return [name for name in re.split(r'[\s,;"]+', _UNIT.sub("", line.lstrip("#/%! ").lower())) if name]


def _may_be_decimals(line: str) -> bool:
    """Whether values that commas separate may as well be half as many numbers with decimal commas."""
    values = line.split(",")
    pairs = len(values) >= 6 and len(values) % 2 == 0
    return pairs and all(map(_WHOLE.fullmatch, values)) and all(value.isdecimal() for value in values[1::2])


def _counts_up(numbers: FloatArray) -> bool:
    """Whether numbers go up by one."""
    return bool((np.diff(numbers) == 1).all())


def _fault(text: str, place: int, line: str) -> ValueError:
    return ValueError(f"line {_number(text, place)} is {quoted(line)}, which does not begin with three numbers")
