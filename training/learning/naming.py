"""Names of factors and coordinates in a bundle: by the sides of the body, and by the configuration."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.training.runs.settings import ExportSettings

#: Sides as seen by a viewer of the collection's axes, as axis and sign; see ``training.space.factor_names``.
SIDES = {"left": (0, -1), "right": (0, 1), "lower": (1, -1), "upper": (1, 1), "back": (2, -1), "front": (2, 1)}


class NamingError(ValueError):
    """The configuration names no existing factor or coordinate, or gives one name to two of them."""


def bundle_names(
    factors: Mapping[str, list[int]], coordinates: Sequence[str], settings: ExportSettings
) -> tuple[dict[str, list[int]], list[str]]:
    """Return the factors and the names of coordinates (m,) in the bundle.

    A coordinate whose name begins with the name of its factor is renamed with the factor. The settings ``faces`` and
    ``up`` turn sides into the body's own, and ``names`` renames single factors and coordinates.

    Raises:
        NamingError: an unknown name, or one name for two.

    >>> plain = ExportSettings(name="a", title="A", description="A.", licence="MIT", faces="+z")
    >>> bundle_names({"upper right bends": [0]}, ["upper right bends"], plain)
    ({'upper left bends': [0]}, ['upper left bends'])
    """
    if unknown := sorted(settings.names.keys() - {*factors, *coordinates}):
        known = ", ".join(f'"{name}"' for name in dict.fromkeys([*factors, *coordinates]))
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
    """Replace the viewer's sides in a name by the sides of a body with the configured orientation."""
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
    return (1.0 if axis[0] == "+" else -1.0) * np.eye(3)["xyz".index(axis[1])]
