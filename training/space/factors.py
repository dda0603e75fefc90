"""Factors of a product shape manifold: groups of modes whose supports overlap (paper, sections 3 and 4).

Modes that move different parts of a surface hardly know of each other: the exponential of their sum is nearly the sum
of their exponentials. Modes that share a part do not have that, and go into one factor, which a network learns whole.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.space.modes import edge_magnitudes

#: Upper bound of the default threshold: groups whose modes overlap more than this on average are always joined.
THRESHOLD = 0.5
#: Default limit on the modes of a factor, since its samples have to fill a box of that dimension.
LARGEST = 9
#: Axes along which a mesh spreads less than this share of its largest spread give no names.
THIN = 0.2
#: A part lies to one side if it is further from the centre than this share of the mesh's standard deviation.
ASIDE = 0.5


class FactorError(ValueError):
    """Factors that can't be formed as asked, with a sentence that says why."""


def overlap(nric: FloatArray, norm: WeightedNorm) -> FloatArray:
    """How much the supports of modes overlap: ``Σ_e |u_i,e| |u_j,e|``, normalised to 1 on the diagonal.

    ``|u_e|`` is the size of a mode on an edge, of its length and its angle together, in the weighted norm.

    Args:
        nric: (m, 2E) modes.
        norm: at their mean.

    Returns:
        (m, m) symmetric, from 0 where supports are disjoint to 1 where the modes are alike.
    """
    sizes = edge_magnitudes(nric, norm)
    sizes /= np.linalg.norm(sizes, axis=1, keepdims=True)
    return sizes @ sizes.T


def between(overlaps: FloatArray, groups: Sequence[Sequence[int]]) -> FloatArray:
    """Overlap of factors (J, J): the average over pairs of modes, one from each.

    Args:
        overlaps: (m, m) of the modes.
        groups: J lists of modes.
    """
    share = np.zeros((len(groups), len(overlaps)))
    for row, group in zip(share, groups, strict=True):
        row[list(group)] = 1 / len(group)
    return share @ overlaps @ share.T


def group(
    overlaps: FloatArray, count: int | None = None, *, threshold: float | None = None, largest: int = LARGEST
) -> list[list[int]]:
    """Form factors by joining, again and again, the two groups that overlap most on average.

    With a ``count`` this goes on until that many are left. Without one it ends when no two groups overlap by more
    than ``threshold`` and have together no more than ``largest`` modes. (Average linkage; written out because a
    dendrogram has no limit on the size of a group, and the limit has to count while groups grow.)

    How much modes overlap at all depends on the collection: nearly everything on a captured body in loose clothes moves
    a little with everything else, the median overlap of two modes is 0.4 there and 0.1 on a hand. So the threshold is
    by default relative: groups are joined that share more than two modes do on average.

    Args:
        overlaps: (m, m) of the modes, which come strongest first.
        count: J, if the user chose it; then ``threshold`` and ``largest`` don't matter.
        threshold: on the average overlap of two groups; by default that of all pairs of modes, but at most 0.5.
        largest: modes of a factor.

    Returns:
        J lists of modes, each in order; the factor of the strongest mode comes first.

    Raises:
        FactorError: a count or a limit that is not possible.
    """
    m = len(overlaps)
    if count is not None and not 1 <= count <= m:
        raise FactorError(f"the number of factors must be from 1 to the number of modes, {m}, not {count}")
    if largest < 1:
        raise FactorError(f"a factor needs room for at least one mode, not {largest}")
    if threshold is None:
        pairs = overlaps[np.triu_indices(m, 1)]
        threshold = min(THRESHOLD, float(pairs.mean())) if len(pairs) else THRESHOLD
    groups = [[j] for j in range(m)]
    while len(groups) > (count or 1):
        shared = between(overlaps, groups)
        np.fill_diagonal(shared, -np.inf)
        if count is None:
            sizes = np.array([len(g) for g in groups])
            shared[np.add.outer(sizes, sizes) > largest] = -np.inf
            if shared.max() <= threshold:
                break
        a, b = sorted(divmod(int(shared.argmax()), len(groups)))
        groups[a] = sorted(groups[a] + groups.pop(b))
    return sorted(groups)


def names(groups: Sequence[Sequence[int]], nric: FloatArray, norm: WeightedNorm, mean: TriangleMesh) -> list[str]:
    """Say where on the mean each factor acts, such as "upper left", without claiming to know what is there.

    As a viewer shows it that has x to the right, y up and z towards the eye (glTF's axes). A part is named by the
    centre of its modes' squares, on every axis that the mesh is not thin along; "middle" where it is to no side.
    Names are unique: the second "upper left" is "upper left 2".

    Args:
        groups: J lists of modes.
        nric: (m, 2E) modes.
        norm: at the mean.
        mean: the shape.
    """
    middles = mean.edge_midpoints
    centre, spread = middles.mean(axis=0), middles.std(axis=0)
    telling = spread >= THIN * spread.max()
    squares = edge_magnitudes(nric, norm) ** 2
    result: list[str] = []
    seen: Counter[str] = Counter()
    for modes in groups:
        weights = (squares[list(modes)] / squares[list(modes)].sum(axis=1, keepdims=True)).mean(axis=0)
        offset = np.where(telling, (weights @ middles - centre) / np.where(telling, spread, 1), 0)
        words = [
            pair[int(offset[axis] > 0)]
            for axis, pair in ((1, ("lower", "upper")), (0, ("left", "right")), (2, ("back", "front")))
            if abs(offset[axis]) > ASIDE
        ]
        name = " ".join(words) or "middle"
        seen[name] += 1
        result.append(name if seen[name] == 1 else f"{name} {seen[name]}")
    return result
