"""Point clouds as text: XYZ, PTS, CSV and TXT in the dialects of scanners, spreadsheets and ParaView.

Such a file does not name its dialect. `_Dialect.of` finds it in the first lines: the separator of columns, a decimal
comma, and the columns of x, y and z. A file that can be read in two ways is refused, and the message tells both.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, as_utf8
from shapespace.files.point_columns import header_names, named_columns, row_numbers, uncounted
from shapespace.files.point_lines import (
    POINT_NUMBER,
    REMARK,
    WHOLE,
    fault,
    is_beside,
    is_point,
    line_number,
    lines,
    tidy,
    without_pipes,
)
from shapespace.mesh.triangle_mesh import MeshError

#: Lines with points in which the dialect is looked for, and lines that may stand before the first point.
_LOOK, _MOST_HEADER = 400, 100
_COMMA_NUMBER = re.compile(r"[+-]?(?:\d+(?:,\d*)?|,\d+)(?:e[+-]?\d+)?", re.IGNORECASE)
_DIGITS = re.compile(r"\d")
_NUMBER_FIRST = re.compile(r"[\s\"'(\[{|]*[+-]?[.,]?\d")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
#: Characters that no text has; the end of a file may have two of them.
_NO_TEXT, _ENDS = re.compile(r"[\0-\x08\x0e-\x1f]"), "\0\x1a\r\n\t "
_MINUS = str.maketrans({"\u2212": "-", "\u2013": "-"})


def read_point_text(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Points (N, 3) of a text with one point a line, and no faces.

    Columns are separated by blanks, tabs, commas, semicolons or pipes. Remarks, a header and the number of points are
    left out. So are labels and row numbers in front, columns behind the coordinates, and points that are NaN.

    Raises:
        MeshError: the text can be read in two ways, or has more points than the limits allow.
        ValueError: a line is no point; the message tells its number.
    """
    text = _decoded(as_utf8(data))
    points, counts = _Dialect.of(text).read(text)
    limits.check(len(points), 0)
    if counts and sum(counts) != len(points):
        raise ValueError(f"it should have {sum(counts)} points, but has {len(points)}")
    missing = np.isnan(points).any(axis=1)
    return points[~missing] if missing.any() else points, np.zeros((0, 3), np.int64)


def _decoded(data: memoryview) -> str:
    """A text in UTF-8 or in the 8-bit encoding of Windows, with an ordinary minus sign."""
    try:
        text = str(data, "utf-8").rstrip(_ENDS)
    except UnicodeDecodeError:
        text = str(data, "cp1252", "replace")
    if _NO_TEXT.search(text[:1000]) or "\ufffd" in text[:1000]:
        raise ValueError("it is not text")
    return text if text.isascii() else text.translate(_MINUS)


@dataclass(frozen=True)
class _Dialect:
    """How the points are written.

    Attributes:
        separator: of columns; None for blanks and tabs, ", " for a comma that a blank follows.
        decimal_comma: whether decimals have a comma.
        columns: of x, y and z.
        numbers: columns of row numbers.
        label: whether column 0 is a word.
        paired: whether a comma separates columns, and also the decimals in each.
        plain: whether lines hold only numbers and separators, so that NumPy can split them.
        header: lines before the first point that are neither a remark nor a number of points.
    """

    separator: str | None
    decimal_comma: bool
    columns: tuple[int, int, int] = (0, 1, 2)
    numbers: tuple[int, ...] = ()
    label: bool = False
    paired: bool = False
    plain: bool = True
    header: int = 0

    @classmethod
    def of(cls, text: str) -> _Dialect:
        """Find the dialect of a text."""
        for label in (False, True):
            sample, heads, header = _beginning(text, label)
            if sample:
                break
        else:
            if (named := cls._by_header(text)) is not None:
                return named
            wrong = next((row for row in lines(text) if _NUMBER_FIRST.match(row[1]) and not is_beside(row[1])), None)
            wrong = wrong or next((row for row in lines(text) if _DIGITS.search(row[1])), None)
            if wrong is None or is_beside(wrong[1]):
                raise ValueError("it holds no line with three numbers: write x, y and z of one point in each line")
            raise fault(text, *wrong)
        found = replace(cls._separation(text, sample, heads, label), header=header)
        rows = [found.split(line) for _, line in sample]
        whole = [[row[k].isdecimal() and int(row[k]) > 0 for k in found.columns] for row in rows]
        if label and all(whole[0]) and len(rows) > 1 and not any(map(any, whole[1:])):
            # It may be a date.
            raise fault(text, *sample[0], beside=sample[1])
        for place, line in islice(lines(text), header + 1):
            # Such a line is no header: it has a label where later lines have none.
            if not label and not is_beside(line) and is_point(line, True) and len(found.split(line)) == len(rows[0]):
                raise fault(text, place, line, beside=sample[0])
        return found._with_columns(rows, heads, f"line {line_number(text, sample[0][0])}")

    @classmethod
    def _by_header(cls, text: str) -> _Dialect | None:
        """The dialect of a text whose header tells columns that are not in front."""
        first = list(islice(lines(text), _LOOK))
        for k, (_, head) in enumerate(first[:_MOST_HEADER]):
            for separator in (one for one in ("\t", ";", ",") if one in head):
                columns = named_columns(header_names(head, separator))
                header = sum(not is_beside(line) for _, line in first[: k + 1])
                sample = [row for row in first[k + 1 :] if not is_beside(row[1])]
                for comma in (False, True) if columns and sample else ():
                    found = cls(separator, comma, columns or (0, 1, 2), plain=False, header=header)
                    if all(found.fits(line) for _, line in sample):
                        rows = [found.split(line) for _, line in sample]
                        return found._with_meant_commas(text, sample, rows, [head]) if separator == "," else found
        return None

    @classmethod
    def _separation(cls, text: str, sample: list[tuple[int, str]], heads: list[str], label: bool) -> _Dialect:
        """The separator and the decimals of sample lines."""
        plain = not label and all(
            '"' not in line and tidy(line) == line.partition("#")[0].rstrip() for _, line in sample
        )
        start = int(label)
        joined = "".join(tidy(line) for _, line in sample)
        kinds: list[tuple[str | None, bool]] = [(";", True), (";", False)] if ";" in joined else []
        if "\t" in joined and (label or any("\t" in head for head in heads)):
            kinds += [("\t", False), ("\t", True)]
        if '"' in joined and "," in joined:
            kinds += [(",", True)]
        kinds += [(", ", True), (None, True), (",", False)] if "," in joined else [(None, False)]
        candidates = [
            cls(separator, comma, (start, start + 1, start + 2), label=label, plain=plain) for separator, comma in kinds
        ]
        found = next((one for one in candidates if all(one.fits(line) for _, line in sample)), None)
        if found is None:
            fitting = [row for row in sample if any(one.fits(row[1]) for one in candidates)]
            wrong = [row for row in sample if row not in fitting]
            first = next((one for one in candidates if fitting and one.fits(fitting[0][1])), None)
            if not wrong and first is not None:
                wrong = [row for row in sample if not first.fits(row[1])]
            raise fault(text, *wrong[0], beside=fitting[0] if fitting else None)
        rows = [found.split(line)[start:] for _, line in sample]
        if found.separator == ",":
            found = found._with_meant_commas(text, sample, rows, heads)
        return found

    def _with_meant_commas(
        self, text: str, sample: list[tuple[int, str]], rows: list[list[str]], heads: list[str]
    ) -> _Dialect:
        """This dialect, or one in which commas are decimals too, if a header says so."""
        start = int(self.label)
        if self.decimal_comma:
            decimals = [value for row in rows for value in row if "," in value]
            if not decimals or not all(map(_THOUSANDS.fullmatch, decimals)):
                return self
            others = "between thousands"
        else:
            splits = [header_names(head, "," if "," in head else None) for head in heads]
            named = {len(names) - start for names in splits if named_columns(names)}
            readings = [_with_decimals(row) for row in rows]
            found = [reading for reading in readings if reading is not None]
            if len(found) < len(rows) or len(rows[0]) in named or {len(row) for row in rows} == {3}:
                return self
            if named & {3, len(found[0])} and all(
                len(row) == 2 * len(reading) for row, reading in zip(rows, found, strict=True)
            ):
                return replace(self, decimal_comma=True, paired=True, plain=False)
            if len({len(row) for row in rows}) == 1 and len(rows[0]) == 4:
                return self
            others = "between columns"
        raise MeshError(
            f"the commas of line {line_number(text, sample[0][0])} can stand before decimals or {others}: write "
            "decimals with a point, or separate columns by semicolons"
        )

    def _with_columns(self, rows: list[list[str]], heads: list[str], where: str) -> _Dialect:
        """This dialect with the columns that a header names, or those behind row numbers."""
        width, start = len(rows[0]), int(self.label)
        separators = [self.separator.strip(" ") if self.separator else "\t", ",", ";", None]
        unknown = False
        for head in reversed(heads):
            splits = [header_names(head, one) for one in separators if one is None or one in head]
            names = min(splits, key=lambda names: (len(names) != width, named_columns(names) is None))
            columns = named_columns(names)
            remark = REMARK.match(head)
            if columns and len(names) == width:
                return replace(self, columns=columns)
            if columns and not remark:
                if columns != (0, 1, 2) and width > 3:
                    raise MeshError(f"its header names {len(names)} columns, and a point has {width}")
                unknown = False
                break
            words = len(names) == width > 3 + start and not any(map(_NUMBER_FIRST.match, names))
            unknown = unknown or (words and not remark)
        if unknown:
            raise MeshError("its header does not tell the columns of the coordinates: name them x, y and z")
        numbers = row_numbers([[v.replace(",", ".") for v in row] for row in rows], start, where)
        x = start + numbers
        return replace(self, columns=(x, x + 1, x + 2), numbers=tuple(range(start, x)))

    def split(self, line: str) -> list[str]:
        """The columns of a line."""
        if not self.plain:
            line = tidy(line)
        if '"' in line:
            separator = self.separator.strip(" ") if self.separator else " "
            line = line if self.separator else line.replace("\t", " ")
            if line[0] == line[-1] == '"' and line.count('"') == 2 + 2 * line.count(f'"{separator}"'):
                return line[1:-1].split(f'"{separator}"')
            values = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
            return [value.strip() for value in values if value or self.separator]
        if self.separator == ", ":
            return re.split(r",\s+", line.rstrip(", "))
        values = [value.strip() for value in line.split(self.separator)]
        if self.paired:
            start = int(self.label)
            pairs = zip(values[start::2], values[start + 1 :: 2], strict=False)
            odd = (len(values) - start) % 2
            return [] if odd else values[:start] + [f"{whole},{part}" for whole, part in pairs]
        return values

    def fits(self, line: str) -> bool:
        """Whether the coordinates in a line are numbers as this dialect writes them."""
        return self._are_point(self.split(line), line)

    def _are_point(self, values: list[str], line: str) -> bool:
        """Whether the coordinates among values in a line are numbers as this dialect writes them."""
        number = _COMMA_NUMBER if self.decimal_comma else POINT_NUMBER
        wanted = (*self.numbers, *self.columns)
        if len(values) <= max(wanted) or not all(number.fullmatch(values[k]) for k in wanted):
            return False
        if self.label and number.fullmatch(values[0]):
            return False
        if self.separator == "," and self.decimal_comma and not self.paired:
            return '"' in line or len(values) == max(wanted) + 1
        # Without a decimal comma it is an ordinary comma with a blank behind it.
        return self.separator != ", " or any("," in values[k] for k in wanted)

    def read(self, text: str) -> tuple[FloatArray, list[int]]:
        """All points (N, 3), and the numbers of points that the text states."""
        counts: list[int] = []
        wanted = (*self.numbers, *self.columns)
        separator = self.separator if self.plain else " "
        places = wanted if self.plain else range(len(wanted))
        if self.separator == ", ":
            separator = None
        try:
            found = np.loadtxt(
                self._values(text, counts), np.float64, comments=None, delimiter=separator, usecols=places, ndmin=2
            )
        except ValueError:
            if self.plain:
                return replace(self, plain=False).read(text)
            wrong = next((row for row in self._rows(text, []) if not self.fits(row[1])), None)
            if wrong is None:
                raise
            raise fault(text, *wrong, beside=next(self._rows(text, []))) from None
        for column in range(len(self.numbers)):
            k = uncounted(found[:, column])
            if k is not None:
                place, _ = next(islice(self._rows(text, []), k, None))
                raise ValueError(f"its first column counts the points, but not in line {line_number(text, place)}")
        return found[:, len(self.numbers) :].copy() if self.numbers else found, counts

    def _values(self, text: str, counts: list[int]) -> Iterator[str]:
        """Lines that NumPy can read: all columns if they are plain, else row numbers and coordinates."""
        wanted = (*self.numbers, *self.columns)
        words: set[str] = set()
        for place, line in self._rows(text, counts):
            if self.plain:
                values = line.partition("#")[0]
                if self.separator == ", ":
                    values = re.sub(r",\s+", " ", values.rstrip(", "))
            else:
                row = self.split(line)
                if not self._are_point(row, line):
                    raise ValueError
                if self.label and not _DIGITS.search(row[0]):
                    words.add(row[0])
                    if len(words) > 1 and row[0] in ("v", "vn", "vt", "vp", "f", "l"):
                        raise MeshError(f"line {line_number(text, place)} is a line of OBJ: name it .obj")
                values = " ".join(row[k] for k in wanted)
            yield values.replace(",", ".") if self.decimal_comma else values

    def _rows(self, text: str, counts: list[int]) -> Iterator[tuple[int, str]]:
        """The lines with points; numbers of points are added to ``counts``."""
        header = self.header
        for place, line in lines(text):
            if WHOLE.fullmatch(line):
                counts.append(int(line))
            elif not REMARK.match(line):
                if header:
                    header -= 1
                else:
                    yield place, line


def _beginning(text: str, label: bool) -> tuple[list[tuple[int, str]], list[str], int]:
    """First lines with points, lines before them that may be a header, and the number of these without remarks."""
    sample: list[tuple[int, str]] = []
    heads: list[str] = []
    header = 0
    for place, line in lines(text):
        if len(sample) == _LOOK or header > _MOST_HEADER:
            break
        if is_point(line, label):
            sample.append((place, line))
        elif not is_beside(line):
            if sample:
                raise fault(text, place, line, beside=sample[0])
            header += 1
            heads.append(without_pipes(line))
        elif not sample and REMARK.match(line):
            heads.append(line)
    return sample, heads, header


def _with_decimals(values: list[str]) -> list[str] | None:
    """Three numbers, or half as many, that values between commas may be with decimal commas; None if they can't."""
    if not all(map(WHOLE.fullmatch, values)):
        return None
    numbers, rest = [], list(values)
    if len(values) > 6:
        # A row number stands in front of pairs.
        numbers = [rest.pop(0)] if len(values) % 2 else []
        pairs = len(rest) // 2
    else:
        pairs = len(values) - 3
    while rest:
        if pairs and len(rest) > 1 and rest[1].isdecimal():
            numbers.append(f"{rest.pop(0)}.{rest.pop(0)}")
            pairs -= 1
        else:
            numbers.append(rest.pop(0))
    return None if pairs else numbers
