"""Lines of a text with points: which are points, and what messages say about the others."""

from __future__ import annotations

import re
from collections.abc import Iterator

from shapespace.mesh.triangle_mesh import MeshError

#: Characters of a line.
_LONGEST_LINE = 2**16
#: A line, or one with separators alone, as spreadsheets write for rows without values.
_LINE = re.compile(r"[,;|][ \t,;|]*+(?=[\r\n]|\Z)|([^\s][^\r\n]*)")
REMARK = re.compile(r"#|//|%|!")
WHOLE = re.compile(r"[+-]?\d+")
POINT_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf)", re.IGNORECASE)
#: Brackets around a point, a mark behind its number, and exponents of Fortran.
_BRACKETS = re.compile(r"^[(\[{\s]+|\s*[)\]}]+[,;\s)\]}]*$")
_MARK = re.compile(r"^(\w+)(?:\s*[:)]|\.(?=[\s;]))\s*")
_FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[+-]?\d)")
#: Signs that a line needs to be tidied.
_ODD = re.compile(r"[(\[{)\]}|:#'dD]|^\w+\.[\s;]")
#: A word in front of the coordinates, with the separator behind it.
_LABEL = re.compile(r'^(?=[^,;\t]*[^\W\d])(?:[^,;\t"]*[,;\t]|"[^"]*"[\s,;]|\S+\s)\s*')


def lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines that are not blank, without blanks at their ends, each with the place in the text where it starts."""
    for match in _LINE.finditer(text):
        if match[1] is None:
            continue
        if match.end() - match.start() > _LONGEST_LINE:
            raise MeshError(f"line {line_number(text, match.start())} has more than {_LONGEST_LINE} characters")
        yield match.start(), match[0].rstrip()


def line_number(text: str, place: int) -> int:
    """Number of the line at a place in the text, from 1."""
    return 1 + max(text.count("\n", 0, place), text.count("\r", 0, place))


def without_pipes(line: str) -> str:
    """A line with semicolons where it had pipes."""
    return line.strip("| ").replace("|", ";") if "|" in line else line


def tidy(line: str) -> str:
    """A line without brackets, marks behind its number, and remarks, and with exponents as usual."""
    if not _ODD.search(line):
        return line
    line = without_pipes(line.partition("#")[0].rstrip().replace("'", '"'))
    line = _BRACKETS.sub("", line)
    line = _MARK.sub(r"\1 ", line)
    return _FORTRAN.sub("e", line)


def is_point(line: str, label: bool) -> bool:
    """Whether a line starts with three numbers, perhaps behind a label, however they are separated."""
    line = tidy(line)
    if label:
        whole = re.split(r"[\s;]", line, maxsplit=1)[0]
        line, found = _LABEL.subn("", line, count=1)
        if not found or is_point(f"{whole} 0 0", False):
            return False
    values = re.split(r"[\s,;]+", line.replace('"', ""), maxsplit=3)[:3]
    return len(values) == 3 and all(map(POINT_NUMBER.fullmatch, values))


def is_beside(line: str) -> bool:
    """Whether a line is a remark or a number of points."""
    return bool(REMARK.match(line) or WHOLE.fullmatch(line))


def fault(text: str, place: int, line: str, beside: tuple[int, str] | None = None) -> ValueError:
    """Error of a line that is no point, or is written otherwise than a line before."""
    says = f"line {line_number(text, place)}"
    if beside is not None and (is_point(line, False) or is_point(line, True)):
        return ValueError(
            f"{says} is written otherwise than line {line_number(text, beside[0])}: write all lines in the same way, "
            "with decimal points"
        )
    return ValueError(f"{says} does not begin with three numbers: write x, y and z there, with decimal points")
