"""Shapes that are held out together.

An error on held-out shapes tells how a model does on new shapes only if nothing like them is known. A mirror image is
known by its original. So is a patient's second scan by the first, and a pose by other bodies in the same pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray

#: Number of folds. Below twice this number of shapes, each shape is held out by itself.
FOLDS = 5
#: Number of inner folds by which modes are chosen, each held out in its turn.
INNER_FOLDS = 5


@dataclass(frozen=True, eq=False)
class Related:
    """Which rows of an array of shapes are related. Mirror images come after all originals."""

    original: IntArray  # (n,) index i of each row's original, from 0; ~i for a local field of shape i
    group: IntArray  # (originals,) index of the group of each original, from 0

    @classmethod
    def none(cls, count: int) -> Related:
        """No shape is related to another."""
        return cls.images(np.arange(count))

    @classmethod
    def images(cls, original: IntArray) -> Related:
        """Return that shapes are related only to their mirror images, by the index (n,) of each row's original."""
        return cls(original, np.arange(int(original.max()) + 1))

    @classmethod
    def of_arrays(cls, shapes: Mapping[str, NDArray]) -> Related:
        """Return the relations among the shapes of a run, see RunDirectory.shapes."""
        every = cls.images(shapes["original"])
        return cls(every.original, shapes["group"]) if "group" in shapes else every

    @property
    def originals(self) -> int:
        """Number of originals."""
        return len(self.group)

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.group.max()) + 1

    @property
    def _of_rows(self) -> IntArray:
        """Return the group (n,) of each row."""
        return self.group[np.where(self.original < 0, ~self.original, self.original)]

    @property
    def _inner_parts(self) -> int:
        """Number of inner folds."""
        return min(INNER_FOLDS, self.groups)

    @property
    def few(self) -> bool:
        """Whether each group is held out by itself, because there are few shapes."""
        return self.originals < 2 * FOLDS

    def some(self, used: NDArray[np.bool_] | IntArray) -> Related:
        """Return the relations among some rows, marked (n,) or at an index (k,)."""
        kept = np.unique(self.original[used], return_inverse=True)
        return Related(kept[1], np.unique(self.group[kept[0]], return_inverse=True)[1])

    def spread(self, most: int) -> NDArray[np.bool_]:
        """Mark (n,) at most this number of originals, spread evenly over the groups, and their mirror images."""
        position = np.empty(self.originals, dtype=int)
        position[np.argsort(self.group, kind="stable")] = np.arange(self.originals)
        return position[self.original] % -(-self.originals // most) == 0

    def without(self, index: IntArray) -> IntArray:
        """Return the rows that are not related to any of the originals at an index (k,)."""
        return np.flatnonzero(~np.isin(self._of_rows, self.group[index]))

    def folds(self) -> list[IntArray]:
        """Return the indices of the originals that are held out together, for each fold."""
        parts = self.groups if self.few else min(FOLDS, self.groups)
        return [np.flatnonzero(self.group % parts == fold) for fold in range(parts)]

    def inner_folds(self) -> list[tuple[IntArray, IntArray]]:
        """Return the rows that are held out together, and the rows that are kept, for each fold.

        Local fields of the shapes that are held out are neither held out nor kept.
        """
        fold, own = self._of_rows % self._inner_parts, self.original >= 0
        parts = range(self._inner_parts)
        return [(np.flatnonzero(own & (fold == part)), np.flatnonzero(fold != part)) for part in parts]

    @property
    def most_modes(self) -> int:
        """Largest number of modes that inner folds support: one less than the originals that a fold keeps.

        A mirror image adds no shape, so it supports no further mode.
        """
        held = np.bincount(self.group % self._inner_parts).max()
        return max(1, self.originals - int(held) - 1)

    def with_local(self, local: FloatArray) -> Related:
        """Return the relations of all shapes and their local fields (n, k, V, 3), which come after them."""
        return Related(np.concatenate([self.original, ~np.repeat(self.original, local.shape[1])]), self.group)

    def about_mean_of(self, kept: IntArray, rows: FloatArray) -> FloatArray:
        """Return rows (n, …) about the mean of those ``kept``, so that they show nothing of the others.

        Local fields have the local fields of this mean as theirs.
        """
        local = np.flatnonzero(self.original < 0)
        own = len(rows) - len(local)
        number = np.zeros(len(rows), dtype=int)
        number[local] = 1 + np.arange(len(local)) % max(1, len(local) // own)  # of the window
        found = rows.copy()
        for each in np.unique(number[kept]):
            found[number == each] -= rows[kept[number[kept] == each]].mean(axis=0)
        return found
