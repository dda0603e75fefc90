"""Stage `factors`: groups of modes whose supports overlap, and the modes in the order of the groups."""

import itertools

import numpy as np

from shapespace.coordinates.nric import WeightedNorm
from shapespace.training.learning.naming import NamingError, bundle_names
from shapespace.training.runs.config import Config
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.space.factor_names import names
from shapespace.training.space.factors import FactorError, between, group, overlap
from shapespace.training.space.shell_collection import names_of
from shapespace.training.stages.stage import Run, Stage, StageWarning

#: Name of the factor of a straight-line model.
WHOLE = "whole shape"


def find_factors(run: Run) -> None:
    """Write ``factors.json``; of meshes also ``modes.npz``, where each factor's latents are a range, as in bundles.
    Dense modes of straight lines are one factor. Raises FactorError if there are fewer modes than factors, if the given
    factors are no partition of the modes, or if ``export.names`` has a name that is not there.
    """
    directory = run.directory
    if run.by_design:
        by_design = run.collection.factors
        directory.factors.write({"factors": list(by_design.values()), "names": list(by_design)})
        return
    found, centre = directory.modes_by_strength.read(), directory.mean_mesh()
    norm = WeightedNorm.of(centre, run.config.material.eta)
    z = np.ascontiguousarray(found["nric"])  # sums round by the order in memory, and files keep that
    shared = overlap(z, norm)
    straight, settings = directory.straight_kind() is not None, run.config.factors
    if straight:
        groups = [list(range(len(z)))]
    elif settings.modes is not None:
        try:
            settings.require_partition(len(z))
        except ValueError as error:
            raise FactorError(str(error)) from None
        groups = [list(members) for members in settings.modes]
    else:
        groups = group(shared, settings.count)
    order = [j for members in groups for j in members]
    ordered = {name: found[name][order] for name in ("nric", "vertices", "lower", "upper", "localisation")}
    ordered |= {name: found[name][:, order] for name in ("coefficients", "mirrored_coefficients")}
    ordered["rank"] = np.array(order)
    directory.modes.write(**found | ordered)
    starts = np.cumsum([0, *map(len, groups)])
    ranges = [list(range(a, b)) for a, b in itertools.pairwise(starts.tolist())]
    named = [WHOLE] if straight else names(groups, z, found["vertices"], norm, centre)
    _require_names(dict(zip(named, ranges, strict=True)), run.config)
    directory.factors.write(
        {
            "factors": ranges,
            "names": named,
            "overlap": between(shared, groups).tolist(),
            "ignored": _ignored(run.config) if straight else [],
        }
    )
    directory.log("found", factors=len(groups), largest=max(map(len, groups)))


def _require_names(factors: dict[str, list[int]], config: Config) -> None:
    """Refuse ``export.names`` that are not there now, rather than after hours, when the bundle is written."""
    try:
        bundle_names(factors, names_of(factors), config.export)
    except NamingError as error:
        raise FactorError(str(error)) from None


def _ignored(config: Config) -> list[str]:
    """Return the given settings that only exponentials have."""
    given = {
        "factors.count": config.factors.count is not None,
        "factors.modes": config.factors.modes is not None,
        "modes.norm": "norm" in config.modes.model_fields_set,
        "modes.sparsity": config.modes.sparsity != "auto",
        "networks.paper": config.networks.paper,
        "evaluation.baselines": config.evaluation.baselines,
    }
    return [name for name, is_given in given.items() if is_given]


def _warnings(run: RunDirectory) -> list[StageWarning]:
    if not (ignored := run.factors.read_if_written().get("ignored")):
        return []
    has = "has" if len(ignored) == 1 else "have"
    sentence = f"{', '.join(ignored)} {has} no effect, because straight lines have one factor and learn no networks"
    return [StageWarning(sentence)]


STAGE = Stage(
    name="factors",
    version=1,
    settings=lambda config: [config.factors],
    run=find_factors,
    results=lambda run: [run.factors.path],
    rewrites=lambda run: [run.modes.path],
    warnings=_warnings,
)
