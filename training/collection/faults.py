"""Faults of a collection's files: each has a file, what is wrong and what to do. One error has all of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from shapespace.files.archives import natural_order

#: Most characters to which a column of the table is filled up.
_WIDEST = 100


class Fault(NamedTuple):
    """One fault."""

    place: str  # path of the file, followed by the shape's name if the file holds several shapes; may be empty
    what: str
    remedy: str = ""

    @classmethod
    def of(cls, place: str, sentence: str, remedy: str = "", *, always: bool = False) -> Fault:
        """Split a sentence at its first semicolon, after which it says what to do.

        Args:
            place: see Fault.
            sentence: what is wrong, with or without what to do.
            remedy: what to do, where the sentence does not say it.
            always: whether the remedy is added to what the sentence says.
        """
        what, _, own = sentence.partition("; ")
        return cls(place, what, f"{own}: {remedy}" if own and always else own or remedy)

    @property
    def sentence(self) -> str:
        """The fault in one line."""
        line = f"{shown(self.place)}: {self.what}" if self.place else self.what
        return f"{line}; {self.remedy}" if self.remedy else line


class IngestError(ValueError):
    """A collection that can't be used: one line about one fault, or a table of several.

    Attributes:
        faults: the faults.
    """

    def __init__(self, *faults: Fault) -> None:
        super().__init__(_table(faults) if len(faults) > 1 else faults[0].sentence)
        self.faults = faults


class Faults:
    """Faults of several files, collected until nothing more can be checked.

    Attributes:
        found: the faults so far.
    """

    def __init__(self, *found: Fault) -> None:
        self.found = list(found)

    @contextmanager
    def gathered(self) -> Iterator[None]:
        """Keep the faults of an IngestError, which ends the block."""
        try:
            yield
        except IngestError as error:
            self.found += error.faults

    def refuse(self) -> None:
        """Raise an IngestError with all faults, sorted by their files; do nothing if there are none."""
        if self.found:
            raise IngestError(*sorted(dict.fromkeys(self.found), key=lambda fault: natural_order(fault.place)))


def shown(name: str) -> str:
    """Return the name of a file on one line, with escapes for characters that can't be printed."""
    return name if name.isprintable() else ascii(name)[1:-1]


def _table(faults: tuple[Fault, ...]) -> str:
    rows = [("file", "what is wrong", "what to do"), *((shown(place), *rest) for place, *rest in faults)]
    widths = [min(max(len(row[k]) for row in rows), _WIDEST) for k in range(2)]
    lines = (f"  {place:{widths[0]}}  {what:{widths[1]}}  {remedy}".rstrip() for place, what, remedy in rows)
    return "\n".join([f"the meshes have {len(faults)} faults:", *lines])
