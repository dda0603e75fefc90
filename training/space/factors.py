"""Factors of a product shape manifold: groups of modes whose supports overlap (paper, sections 3 and 4).

For modes that move different parts of a surface, the exponential of the sum is nearly the sum of the exponentials. This
does not hold for modes that move the same part. Such modes form one factor, and one network learns it.
"""

from collections.abc import Sequence

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm
from shapespace.training.space.modes import edge_magnitudes

#: Groups whose modes overlap more than this on average are joined in any collection.
HIGHEST_THRESHOLD = 0.5
#: Most modes of a factor, because its samples have to fill a box of that dimension.
LARGEST_FACTOR = 9


class FactorError(ValueError):
    """Factors that can't be formed as asked, with a sentence that says why."""


def overlap(nric: FloatArray, norm: WeightedNorm) -> FloatArray:
    """Overlap of the supports of modes: ``Σ_e |u_i,e| |u_j,e|``, normalised to 1 on the diagonal.

    ``|u_e|`` is the size of a mode (2E,) on an edge, of its length and its angle together, in the norm at the mean. The
    result (m, m) is symmetric, from 0 where supports are disjoint to 1 where the modes are alike.
    """
    sizes = edge_magnitudes(nric, norm)
    sizes /= np.linalg.norm(sizes, axis=1, keepdims=True)
    return sizes @ sizes.T


def between(overlaps: FloatArray, groups: Sequence[Sequence[int]]) -> FloatArray:
    """Overlap of factors (J, J): the average of the overlaps (m, m) over pairs of modes, one from each factor."""
    share = np.zeros((len(groups), len(overlaps)))
    for row, group in zip(share, groups, strict=True):
        row[list(group)] = 1 / len(group)
    return share @ overlaps @ share.T


def group(overlaps: FloatArray, count: int | None = None) -> list[list[int]]:
    """Form factors by repeatedly joining the two groups with the largest average overlap (average linkage).

    With a ``count``, J, joining ends when ``count`` groups are left. As long as other groups can be joined, no group
    gets more than twice the mean number of modes. Otherwise one factor may take nearly all modes of a face, which are
    too many to learn. Without ``count``, two groups are joined if they have
    together at most `LARGEST_FACTOR` modes and overlap more than two modes do on average, since the usual overlap
    depends on the collection: its median is 0.4 on a captured body in loose clothes, where nearly everything moves a
    little with everything else, and 0.1 on a hand. The algorithm is written out because a dendrogram has no limit on
    the size of groups.

    Returns J lists of modes, each in order; the factor of the strongest mode comes first. Raises FactorError if the
    count is not possible.
    """
    m = len(overlaps)
    if count is not None and not 1 <= count <= m:
        raise FactorError(f"the number of factors must be from 1 to the number of modes, {m}, not {count}")
    pairs = overlaps[np.triu_indices(m, 1)]
    threshold = min(HIGHEST_THRESHOLD, float(pairs.mean())) if len(pairs) else HIGHEST_THRESHOLD
    most = LARGEST_FACTOR if count is None else 2 * -(-m // count)
    groups = [[j] for j in range(m)]
    while len(groups) > (count or 1):
        shared = between(overlaps, groups)
        np.fill_diagonal(shared, -np.inf)
        sizes = np.array([len(g) for g in groups])
        limited = np.where(np.add.outer(sizes, sizes) > most, -np.inf, shared)
        if count is None and limited.max() <= threshold:
            break
        if np.isfinite(limited.max()):
            shared = limited
        a, b = sorted(divmod(int(shared.argmax()), len(groups)))
        groups[a] = sorted(groups[a] + groups.pop(b))
    return sorted(groups)
