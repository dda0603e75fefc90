"""Options of the three searches for a latent code: ``encode``, ``edit`` and ``fit_scan``.

Each option is written here once, with its name, type, default, limits and description. The library takes the classes or
single options by name. The HTTP interface derives its query parameters and JSON bodies from these classes.
"""

import inspect
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Integral
from typing import Self

from shapespace.model.choice import Choice
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Bounds

#: Limits of a seed, in pydantic's names as all metadata of the fields here: the HTTP interface checks them.
_SEED = {"ge": 0, "lt": 2**63}


class Objective(Choice):
    """What ``encode`` minimises: vertex distances after rigid alignment, or differences of lengths and angles."""

    VERTICES = "vertices"
    NRIC = "nric"


class PriorKind(Choice):
    """Which changes of a code cost least in ``edit``: changes of few factors, or small changes of all factors."""

    GROUPS = "groups"
    RIDGE = "ridge"


class ScaleChoice(Choice):
    """Whether a scan has the size of the model's shapes, or ``fit_scan`` estimates its size."""

    FIXED = "fixed"
    FREE = "free"


class Prior(Choice):
    """Distribution of codes that ``fit_scan`` assumes: the training codes' Gaussian, or uniform in the bounds."""

    POPULATION = "population"
    BOX = "box"


@dataclass(frozen=True)
class Target:
    """Position that a vertex should have after an edit.

    Attributes:
        vertex: index in the mesh that the option ``mesh`` names, from 0.
        position: x, y and z in the frame and the units of the shape that ``decode`` returns for the start.
        sigma: standard deviation of each coordinate, in the same units. The default is half a percent of the bounding
            box's diagonal. A target with twice the standard deviation has a quarter of the weight.

    >>> import shapespace
    >>> shapespace.Target(vertex=100, position=(0.1, 0.5, 0.2), sigma=0.01).vertex
    100
    """

    vertex: int
    position: Sequence[float]
    sigma: float | None = field(default=None, metadata={"gt": 0})


@dataclass(frozen=True)
class Landmark:
    """Position of a known vertex on the scan.

    Attributes:
        vertex: index in the fine mesh, from 0.
        position: x, y and z in the scan's units and frame.
        sigma: standard deviation of the position, in the scan's units. The default is a hundredth of the model's
            diagonal.

    >>> import shapespace
    >>> nose = shapespace.Landmark(vertex=5, position=(0, 1, 0), sigma=0.01)
    >>> shapespace.FitOptions(landmarks=[nose]).landmarks[0].position
    (0, 1, 0)
    """

    vertex: int
    position: Sequence[float]
    sigma: float | None = field(default=None, metadata={"gt": 0})


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """Options that all searches for a code have. Enumerations may be given as plain strings.

    Attributes:
        fixed: coordinates that keep a value, inside the bounds or up to 100 times their width outside: values by index,
            from 0.
        samples: number of random codes to draw from the posterior, a Gaussian around the code with the ``covariance``
            of the answer.
        seed: seed of all random numbers. The same seed gives the same answer.
    """

    fixed: Mapping[int, float] = field(default_factory=dict, metadata={"examples": [{0: 0.5}]})
    samples: int = field(default=0, metadata={"ge": 0})
    seed: int = field(default=0, metadata=_SEED)

    def __post_init__(self) -> None:
        for option in fields(self):
            value = getattr(self, option.name)
            if isinstance(option.default, Choice):
                object.__setattr__(self, option.name, type(option.default)(value))
            elif option.type is int:
                most = option.metadata.get("lt", math.inf)
                if not (isinstance(value, Integral) and 0 <= int(value) < most):
                    above = "" if most == math.inf else f", below {most:.2g}"
                    raise ValueError(f"{option.name} is {value}. Give a whole number of at least 0{above}.")

    @classmethod
    def of(cls, options: Self | None, changes: Mapping[str, object]) -> Self:
        """Return the options, or the defaults, with changes by name.

        Raises:
            TypeError: other options than of this class, or an unknown name.
            ValueError: a string that is no value of its enumeration, or a number that is too small or too large.
        """
        if options is None:
            options = cls()
        if not isinstance(options, cls):
            raise TypeError(f"options must be {cls.__name__}, not {options!r}. Pass single options by name.")
        names = [option.name for option in fields(cls)]
        if unknown := [name for name in changes if name not in names]:
            raise TypeError(f"there is no option {unknown[0]!r}: choose among {', '.join(names)}")
        return replace(options, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class EncodeOptions(SearchOptions):
    """Options of ``encode``.

    Attributes:
        bounds: ``allow`` accepts a code up to half the bounds' width outside the bounds, or four times for straight
            lines, ``clamp`` searches inside the bounds only, ``reject`` refuses a code outside.
        objective: what is smallest: ``vertices``, distances after rigid alignment, or ``nric``, differences of lengths
            and angles in their weighted norm.

    >>> import shapespace
    >>> shapespace.EncodeOptions(objective="nric", fixed={0: 0.5}).objective
    <Objective.NRIC: 'nric'>
    """

    bounds: Bounds = Bounds.ALLOW
    objective: Objective = Objective.VERTICES


@dataclass(frozen=True, kw_only=True)
class EditOptions(SearchOptions):
    """Options of ``edit``.

    Attributes:
        prior: weight of the mean square change of the code, as a fraction of the bounds' width, against the mean square
            distance from the targets, as a fraction of the bounding box's diagonal. With the default, a code half the
            bounds away costs as much as half a percent of the diagonal.
        prior_kind: cost of a change: ``groups``, the squared sum of the factors' norms, changes few factors; ``ridge``,
            the sum of squares, changes all factors a little.
        mesh: mesh that the targets' vertices belong to.
        sigma: standard deviation of targets that have none, of all or by vertex.
        anchored: whether only vertices without a target decide where the whole shape lies. Targets out of reach then do
            not carry the shape along.

    >>> import shapespace
    >>> shapespace.EditOptions(prior=1e-3, prior_kind="ridge").mesh
    <MeshChoice.FINE: 'fine'>
    """

    prior: float = field(default=1e-4, metadata={"ge": 0})
    prior_kind: PriorKind = PriorKind.GROUPS
    mesh: MeshChoice = MeshChoice.FINE
    sigma: float | Mapping[int, float] | None = None
    anchored: bool = False


@dataclass(frozen=True, kw_only=True)
class FitOptions(SearchOptions):
    """Options of ``fit_scan``.

    Attributes:
        scale: ``fixed``: the scan has the size of the model's shapes; ``free``: the fit estimates its size too.
        partial: whether the scan shows only a part of the shape, for example from one camera.
        noise: standard deviation of the scan's points, in the scan's units. By default the fit estimates it.
        landmarks: vertices with known positions. Three or more decide where the search begins.
        distribution: assumed distribution of codes: ``population``, the Gaussian of the training codes, or ``box``,
            uniform inside the bounds.
        points: whether to return the distance of each point and of each vertex.
        used: whether to return the points that represented the scan, for display beside the shape.

    >>> import shapespace
    >>> shapespace.FitOptions(partial=True, scale="free").scale
    <ScaleChoice.FREE: 'free'>
    """

    scale: ScaleChoice = ScaleChoice.FIXED
    partial: bool = False
    noise: float | None = field(default=None, metadata={"gt": 0})
    landmarks: Sequence[Landmark] = field(default=(), metadata={"examples": [[Landmark(5, (0, 1, 0), 0.01)]]})
    distribution: Prior = Prior.POPULATION
    points: bool = False
    used: bool = False


def descriptions(kind: type) -> dict[str, str]:
    """Return the lines on attributes in the docstrings of a class and its bases, as Markdown."""
    found: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        _, _, section = inspect.cleandoc(each.__doc__ or "").partition("Attributes:\n")
        for name, text in re.findall(r"^    (\w+): (.*(?:\n        .*)*)", section, re.MULTILINE):
            plain = " ".join(text.split()).replace("``", "`")
            found[name] = plain[0].upper() + plain[1:]
    return found
