"""Comparison of two groups of shapes by the codes of a model, with p-values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import orth

from shapespace.arrays import FloatArray
from shapespace.counted import counted
from shapespace.model.shape_model import ShapeModel

#: Covariates, and what they leave of a column, count as nothing below this share of their size: rounding errors.
ROUNDING = 1e-9
#: Shortest mean direction of angles, from 0 to 1, that counts as their mean.
TOGETHER = 0.3


class InvalidGroupsError(ValueError):
    """Codes, groups or covariates that can't be compared; the message says what to do."""


@dataclass(frozen=True, eq=False)
class GroupComparison:
    """Result of `compare_groups`.

    Attributes:
        p: p-value of the whole shape: how often groups drawn at random differ at least as much.
        p_each: (m,) p-values of the numbers of the code, corrected for testing all of them (Benjamini and Hochberg
            1995). 1 for numbers that don't vary.
        difference: (m,) difference of the codes, second group minus first, at equal covariates.
        means: (2, m) codes of both groups at the mean of the covariates; without covariates, the groups' mean codes.
        groups: the two labels, in the order of ``means``.
    """

    p: float
    p_each: FloatArray
    difference: FloatArray
    means: FloatArray
    groups: tuple[object, object]


def compare_groups(
    model: ShapeModel,
    codes: ArrayLike,
    group: Sequence[object] | NDArray,
    covariates: ArrayLike | None = None,
    *,
    draws: int = 9999,
    seed: int = 0,
) -> GroupComparison:
    """Test whether the codes of two groups of shapes differ, as a whole and number by number.

    Each number of the code is predicted by the group and the covariates in a linear regression. Its statistic is the
    t-value of the group; that of the whole shape is the root of the sum of their squares. Random groups come from
    permuting what the covariates leave unexplained (Freedman and Lane 1983). Without covariates this is the permutation
    test of two groups, which is exact.

    Args:
        model: the model of the codes. Angles are taken the shorter way round from their mean.
        codes: (n, m), one row for each subject.
        group: (n,) labels of two kinds, such as true and false, or names. Sorted, the first label is the first group.
        covariates: (n,) or (n, c) numbers that may explain differences too, such as age and sex (0 or 1).
        draws: number of random groups. The smallest possible p-value is 1/(draws + 1).
        seed: seed of the random groups.

    Raises:
        InvalidGroupsError: not two groups of at least two; labels or rows missing; numbers that are not finite; angles
            without a mean; too many covariates; or groups that the covariates tell apart exactly.

    >>> import numpy as np, shapespace
    >>> model = shapespace.load("figure")
    >>> codes = model.sample(40, seed=1)
    >>> patient = np.arange(40) < 20
    >>> codes[patient, 0] += 1.2
    >>> found = shapespace.compare_groups(model, codes, patient)
    >>> found.p < 0.05, [name for name, p in zip(model.names, found.p_each) if p < 0.05]
    (True, ['left hip, 1'])
    """
    if draws < 1 or seed < 0:
        raise InvalidGroupsError(f"draws is {draws} and seed is {seed}. Give at least 1 and at least 0.")
    rows = _table(codes, "codes")
    n = len(rows)
    if rows.shape[1] != model.dimension:
        raise InvalidGroupsError(
            f"The codes have {counted(rows.shape[1], 'number')}, but {model.latents.model} takes {model.dimension}."
        )
    labels, second = _two_groups(group, n)
    known = np.empty((n, 0)) if covariates is None else _table(covariates, "covariates")
    if len(known) != n:
        raise InvalidGroupsError(f"There are {counted(len(known), 'row')} of covariates for {counted(n, 'code')}.")
    rows = _unrolled(model, rows)
    # Columns may be constant, or follow from others, as those of all sites do.
    centred = known - known.mean(axis=0)
    lengths = np.linalg.norm(centred, axis=0)
    varied = lengths > ROUNDING * np.linalg.norm(known, axis=0)
    basis = np.column_stack([np.full(n, n**-0.5), orth(centred[:, varied] / lengths[varied], rcond=ROUNDING)])

    def unexplained(values: FloatArray) -> FloatArray:
        """Return what the covariates leave of columns (n, …)."""
        left: FloatArray = values - basis @ (basis.T @ values)
        return left

    member = unexplained(second.astype(float))
    information, freedom = float(member @ member), n - basis.shape[1] - 1
    if freedom < 1:
        raise InvalidGroupsError(f"{counted(n, 'code')} are too few for {counted(known.shape[1], 'covariate')}.")
    if information <= ROUNDING * n:
        raise InvalidGroupsError("The covariates tell the groups apart exactly, so nothing else can be tested.")
    left = unexplained(rows)
    told = np.linalg.norm(left, axis=0) > ROUNDING * np.linalg.norm(rows, axis=0)
    if not told.any():
        raise InvalidGroupsError("The codes don't vary, apart from what the covariates explain.")

    def squares(columns: FloatArray) -> FloatArray:
        """Return squared t-values of the group for columns without covariates."""
        explained = np.outer(member, member @ columns / information)
        rest = ((columns - explained) ** 2).sum(axis=0)
        # Where the group explains everything, the quotient is finite, so that all such groups differ as much.
        return np.asarray((explained**2).sum(axis=0) / np.maximum(rest, ROUNDING * spread) * freedom)

    left_told = left[:, told]
    spread, random = (left_told**2).sum(axis=0), np.random.default_rng(seed)
    own = squares(left_told)
    # Groups that only exchange alike subjects differ as much, apart from rounding.
    limits, whole = own * (1 - 1e-6), own.sum() * (1 - 1e-6)
    as_much, as_much_in_all = np.zeros(len(own), int), 0
    for _ in range(draws):
        drawn = squares(unexplained(random.permutation(left_told)))
        as_much += drawn >= limits
        as_much_in_all += int(drawn.sum() >= whole)
    from scipy.stats import false_discovery_control  # takes longer to import than a model

    each = np.ones(model.dimension)
    each[told] = false_discovery_control((1 + as_much) / (draws + 1))
    difference = member @ left / information
    share = second.mean()
    means = rows.mean(axis=0) + np.outer([-share, 1 - share], difference)
    return GroupComparison((1 + as_much_in_all) / (draws + 1), each, difference, means, labels)


def _table(values: ArrayLike, what: str) -> FloatArray:
    """Return finite numbers as (n, c). Raises InvalidGroupsError."""
    try:
        found = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise InvalidGroupsError(f"The {what} must be numbers. Leave out rows of shapes that were refused.") from None
    found = found[:, None] if found.ndim == 1 and what == "covariates" else found
    if found.ndim != 2:
        raise InvalidGroupsError(f"The {what} must be a table with a row for each subject, not {found.shape}.")
    bad = np.argwhere(~np.isfinite(found))
    if len(bad):
        raise InvalidGroupsError(f"Row {bad[0, 0]} of the {what} has a number that is not finite. Leave the row out.")
    return found


def _two_groups(group: Sequence[object] | NDArray, n: int) -> tuple[tuple[object, object], NDArray[np.bool_]]:
    """Return the two labels, and whether each row (n,) has the second. Raises InvalidGroupsError."""
    given = np.asarray(group)
    if given.shape != (n,):
        raise InvalidGroupsError(f"There are {counted(n, 'code')}. Give a label for each, not {given.shape}.")
    if any(label is None or label != label for label in given.tolist()):  # NaN
        raise InvalidGroupsError("A label is missing. Leave its row out.")
    labels, which, counts = np.unique(
        given.astype(str) if given.dtype == object else given, return_inverse=True, return_counts=True
    )
    if len(labels) != 2 or counts.min() < 2:
        found = ", ".join(f"{label} ({count})" for label, count in zip(labels[:5], counts, strict=False))
        raise InvalidGroupsError(f"Give two groups of at least two subjects; there are {len(labels)}: {found}.")
    first, second = labels.tolist()
    return (first, second), which == 1


def _unrolled(model: ShapeModel, codes: FloatArray) -> FloatArray:
    """Return codes (n, m) whose angles lie within half a period of their mean direction.

    Raises InvalidGroupsError if angles have none.
    """
    centre = codes.mean(axis=0)
    for k, period in enumerate(model.period):
        if period is not None:
            direction = np.exp(2j * np.pi / period * codes[:, k]).mean()
            if abs(direction) < TOGETHER:
                raise InvalidGroupsError(
                    f"The angles of {model.names[k]} point all ways, so they have no mean. Set number {k} of all "
                    "codes to 0 to leave it out."
                )
            centre[k] = np.angle(direction) * period / (2 * np.pi)
    return np.asarray(centre + model.latents.shorter(codes - centre))
