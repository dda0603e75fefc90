"""What factors and coordinates are called in a bundle: by the body's own sides, and as the configuration says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.training.runs.config import ExportSettings

#: Sides as a viewer of the collection's axes sees them, see ``training.space.factors.names``: axis and sign.
SIDES = {"left": (0, -1), "right": (0, 1), "lower": (1, -1), "upper": (1, 1), "back": (2, -1), "front": (2, 1)}


class NamingError(ValueError):
    """Names that no factor or coordinate has, or one that two would have."""


def called(
    factors: Mapping[str, list[int]], coordinates: Sequence[str], settings: ExportSettings
) -> tuple[dict[str, list[int]], list[str]]:
    """Factors and the names of coordinates (m,) as a bundle has them.

    Args:
        factors: coordinates by name, as the run found them.
        coordinates: (m,) names; where they begin with their factor's, they follow it.
        settings: ``faces`` and ``up`` turn sides into the body's own, ``names`` name what they mention.

    Raises:
        NamingError: names of nothing, or one name for two.

    >>> plain = ExportSettings(name="a", title="A", description="A.", licence="MIT", faces="+z")
    >>> called({"upper right": [0]}, ["upper right"], plain)
    ({'upper left': [0]}, ['upper left'])
    """
    if unknown := sorted(settings.names.keys() - {*factors, *coordinates}):
        known = ", ".join(dict.fromkeys([*factors, *coordinates]))
        raise NamingError(
            f"export.names has {unknown[0]!r}, which is neither a factor nor a coordinate. There are {known}."
        )
    own = {name: settings.names.get(name, _of_the_body(name, settings)) for name in factors}
    names = list(coordinates)
    for factor, members in factors.items():
        for k in members:
            name = coordinates[k]
            follows = own[factor] + name[len(factor) :] if name.startswith(factor) else _of_the_body(name, settings)
            names[k] = settings.names.get(name, own[factor]) if name == factor else settings.names.get(name, follows)
    for kind, some in (("factors", list(own.values())), ("coordinates", names)):
        if twice := [name for name, count in Counter(some).items() if count > 1]:
            raise NamingError(f"Two {kind} would be called {twice[0]!r}. Give them different names in export.names.")
    return {own[name]: members for name, members in factors.items()}, names


def _of_the_body(name: str, settings: ExportSettings) -> str:
    """A name with the viewer's sides replaced by those of a body that faces somewhere."""
    if settings.faces is None:
        return name
    up, front = _direction(settings.up), _direction(settings.faces)
    own = {"left": np.cross(up, front), "right": np.cross(front, up), "lower": -up, "upper": up}
    own |= {"back": -front, "front": front}

    def word(said: str) -> str:
        if said not in SIDES:
            return said
        axis, sign = SIDES[said]
        return next(side for side, direction in own.items() if sign * direction[axis] > 0)

    return " ".join(map(word, name.split(" ")))


def _direction(axis: str) -> FloatArray:
    """(3,) of an axis such as "+y"."""
    return (1.0 if axis[0] == "+" else -1.0) * np.eye(3)["xyz".index(axis[1])]
