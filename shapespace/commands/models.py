"""The command ``models``: a table of the models that have a name."""

from __future__ import annotations

from shapespace.bundle import finding
from shapespace.command_line import carry_out, fail

PARAMS = ()
_HEAD = ("name", "version", "numbers", "licence", "title")


def models() -> int:
    """Print a line for each model, with the numbers in its code; return 0 if there is one."""
    return carry_out(_print_table, ())


def _print_table() -> int:
    found = finding.models().values()
    rows = [(each.name, each.version, str(each.dimension), each.licence, each.title) for each in found]
    if not rows:
        return fail("there are no models here and none is installed: name the folder of a bundle instead")
    widths = [max(map(len, column)) for column in zip(_HEAD, *rows, strict=True)]
    for row in (_HEAD, *rows):
        print("  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    return 0
