"""Stage `networks`: the networks that are exported, and those that are trained for comparison."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from shapespace.training.runs.config import Config
from shapespace.training.runs.sampling import FEWEST, SamplesError, indices
from shapespace.training.stages.stage import Run, Stage

# PyTorch, which takes more than a second to load, is loaded where a stage needs it.
if TYPE_CHECKING:
    from shapespace.training.learning.learner import Learner


def learner_of(run: Run) -> Learner:
    """Return the networks of a run that has samples."""
    from shapespace.training.learning.learner import Learner

    samples = run.directory.stamp("samples").read()["key"]
    return Learner(run.collection, run.config, run.directory, f"{samples}, {STAGE.version}")


def train_networks(run: Run) -> None:
    """Write ``networks/``: one file for each network and all histories; files that are no longer needed are removed.
    Straight-line models have no network to train.
    Raises SamplesError if there are too few samples to learn from.
    """
    directory = run.directory
    if directory.straight_kind():
        directory.histories.write({})
        return
    kinds = {"joint samples": directory.samples}
    kinds |= {
        f"samples of factor {name!r}": directory.factor_samples(j) for j, name in enumerate(run.collection.factors)
    }
    for kind, path in kinds.items():
        if (found := len(indices(path))) < FEWEST:
            raise SamplesError(
                f"there are only {found} {kind}, but networks need at least {FEWEST}; raise samples.count"
            )
    learner = learner_of(run)
    learner.main()
    if run.config.evaluation.baselines:
        learner.monolithic()
        learner.monolithic_paper()
    if run.config.networks.paper:
        learner.paper()
    directory.histories.write(learner.histories)
    for path in directory.networks():
        if path.stem not in learner.histories:
            path.unlink()


def _settings(config: Config) -> list[BaseModel | dict[str, Any]]:
    """Return the settings in the key. Version 0.2 also trained the variants, and its runs have to keep their keys.

    Version 0.2 always trained the baselines. Its runs need not be done again without them.
    """
    row: dict[str, Any] = {"title": "", "base": None, "factors": {}, "combiner": {}}
    variants = config.model_dump(mode="json")["variants"].values()
    asked = [{"baselines": True}] if config.evaluation.baselines else []
    networks = config.networks.model_dump(mode="json", exclude={"device"})
    rows = (row | variant for variant in variants)
    return [networks, config.monolithic, config.monolithic_paper, *rows, *asked]


# A network's file is named by a digest of all that the network depends on. So a change of settings keeps the networks
# that it does not touch.
STAGE = Stage(
    name="networks",
    version=5,
    settings=_settings,
    run=train_networks,
    results=lambda run: [run.histories.path],
    rewrites=lambda run: run.networks(),
)
