"""Groups of related shapes, by their names."""

import re
from collections.abc import Sequence

import numpy as np

from shapespace.arrays import IntArray
from shapespace.counted import counted
from shapespace.training.collection.faults import Fault, IngestError

#: Regular expression of a subject's name in the Brain Imaging Data Structure (BIDS).
SUBJECT = "sub-[a-zA-Z0-9]+"
#: Fewest groups: errors are measured without one of them, and two others still differ.
FEWEST = 3


def groups_of(names: Sequence[str], expression: str) -> IntArray:
    """Return the group (n,) of each name, from 0. Names in which a regular expression finds the same are in one group.

    A name in which it finds nothing is a group by itself. Raises IngestError if it finds nothing, or too few groups.
    """
    found = [re.search(expression, name) for name in names]
    if not any(found):
        what = f"finds {expression!r} in no name of a shape, such as {names[0]!r}"
        raise IngestError(Fault("collection.related", what, "give a part of the names that related shapes share"))
    texts = [f"part {match[0]}" if match else f"name {name}" for match, name in zip(found, names, strict=True)]
    groups: IntArray = np.unique(texts, return_inverse=True)[1]
    if (count := int(groups.max()) + 1) < FEWEST:
        what = f"makes {counted(count, 'group')} of the shapes, but {FEWEST} are needed, because some are left out"
        raise IngestError(Fault("collection.related", what, "without this setting, single shapes are left out"))
    return groups


def subjects_repeat(names: Sequence[str]) -> bool:
    """Return whether all names have a subject as in BIDS, some of them the same."""
    subjects = {match[0] if (match := re.search(SUBJECT, name)) else None for name in names}
    return None not in subjects and FEWEST <= len(subjects) < len(names)
