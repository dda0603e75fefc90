"""Studies on a finished run: an ablation, fewer training samples, and other seeds.

``python -m benchmarks.studies runs/NAME`` measures what `studies.toml` lists for NAME. ``--variants``, ``--fractions``
and ``--seeds`` select studies; fractions and seeds can be given as values. The networks go into the run's folder, so a
repeated call reads them. The figures go into its ``evaluation.json``, under the keys of `EMPTY`, and into its report.
Rerunning the stage `networks` or `evaluation` of the run removes them.
"""

from __future__ import annotations

import argparse
import time
import tomllib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from shapespace.arrays import IntArray
from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import nric
from shapespace.training.learning.composite import Composite, affine_sum
from shapespace.training.learning.evaluation import HeldOutSamples, size_bytes
from shapespace.training.learning.learner import Learner
from shapespace.training.report.page import write_report
from shapespace.training.runs.config import load
from shapespace.training.runs.network_settings import Recipe
from shapespace.training.runs.sampling import split
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.results import remember
from shapespace.training.stages.run import STAGES
from shapespace.training.stages.stage import Run

#: The studies of the runs behind the measurement pages, by the name of the run's folder.
LISTED = Path(__file__).with_name("studies.toml")
#: Figures of a run without studies, by their keys in ``evaluation.json``.
EMPTY: dict[str, Any] = {"variants": {}, "fractions": [], "seeds": []}


class Variant(BaseModel):
    """One row of an ablation: the settings that differ from the main recipe, or from another variant."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    """Name in the report and in tables."""
    base: str | None = None
    """Name of the variant to start from, which must be listed earlier. None starts from the main recipe."""
    factors: list[dict[str, Any]] | dict[str, Any] = {}
    """Changed settings of the factor networks: one table for each factor, or one table for all factors."""
    combiner: dict[str, Any] = {}
    """Changed settings of the combiner. A correction of another kind starts from the defaults of that kind."""

    def applied(self, base: Recipe) -> Recipe:
        """Apply the changes to a recipe.

        Raises:
            ValueError: the numbers of tables of factors differ; or (ValidationError) a setting is invalid.
        """
        below = base.model_dump(include=set(Recipe.model_fields))
        mine, theirs = self.factors, below["factors"]
        if isinstance(mine, list) or isinstance(theirs, list):
            count = len(theirs if isinstance(theirs, list) else mine)
            theirs = theirs if isinstance(theirs, list) else [theirs] * count
            mine = mine if isinstance(mine, list) else [mine] * count
            if len(mine) != len(theirs):
                raise ValueError(f"factors: {len(mine)} tables over {len(theirs)}")
            factors: Any = [_merged(a, b) for a, b in zip(theirs, mine, strict=True)]
        else:
            factors = _merged(theirs, mine)
        return Recipe.model_validate({"factors": factors, "combiner": _merged(below["combiner"], self.combiner)})


def recipes(main: Recipe, variants: Mapping[str, Variant]) -> dict[str, Recipe]:
    """Return the full recipe of each variant.

    Raises:
        ValueError: names the variant and its fault.
    """
    found: dict[str, Recipe] = {}
    for name, variant in variants.items():
        if variant.base is not None and variant.base not in found:
            raise ValueError(f"variants.{name}.base: no variant {variant.base!r} stands before it")
        try:
            found[name] = variant.applied(found[variant.base] if variant.base else main)
        except ValueError as error:
            raise ValueError(f"variants.{name}: {error}") from error
    return found


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Merge nested tables; values of ``above`` win, and a table of another ``kind`` replaces the whole table."""
    result = dict(below)
    for name, value in above.items():
        old = below.get(name)
        if isinstance(value, dict) and isinstance(old, dict) and value.get("kind", old.get("kind")) == old.get("kind"):
            value = _merged(old, value)
        result[name] = value
    return result


class Studies(BaseModel):
    """Studies of one run."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    variants: dict[str, Variant] = {}
    """Rows of the ablation, measured on the validation codes."""
    fractions: list[Annotated[float, Field(gt=0, lt=1)]] = []
    """Shares of the training codes to learn from. Factor networks learn once from the factors' parts of these codes
    only, as in the paper, and once from all samples of the factors."""
    seeds: list[int] = []
    """Further seeds of the split and of the networks, for the spread of the figures."""

    @classmethod
    def listed(cls, name: str) -> Studies:
        """Return the studies that `LISTED` has for a run; none for other runs."""
        return cls.model_validate(tomllib.loads(LISTED.read_text(encoding="utf-8")).get(name, {}))


class ShareLearner(Learner):
    """Learner from a share of the training codes, the first rows of the split, since codes are independent.

    Args:
        whole: learner of the run.
        share: of the training codes and of the validation codes, between 0 and 1.
        all_of_factors: whether factor networks still learn from all samples of the factors.
    """

    def __init__(self, whole: Learner, share: float, *, all_of_factors: bool = False) -> None:
        super().__init__(whole.collection, whole.config, whole.run, whole.data_key)
        self.share, self.factor_share = share, 1.0 if all_of_factors else share

    @property
    def rows(self) -> dict[str, IntArray]:
        """The share of the split to learn from, without the collection's own shapes, and all of the test codes."""
        return {
            name: index if name == "test" else index[: max(4, round(self.share * len(index)))]
            for name, index in self.split.items()
        }

    def factor_rows(self, index: IntArray) -> dict[str, IntArray]:
        """Rows of a factor's samples at parts of the share's codes; all rows with ``all_of_factors``."""
        if self.factor_share == 1:
            return super().factor_rows(index)
        return {
            name: np.flatnonzero(np.isin(index, self.joint.index[self.rows[name]])) for name in ("train", "validation")
        }


class SeedLearner(Learner):
    """Learner with another seed of the networks, and another split of the samples.

    Args:
        whole: learner of the run.
        seed: differs from the seed of the run.
    """

    def __init__(self, whole: Learner, seed: int) -> None:
        super().__init__(whole.collection, whole.config, whole.run, whole.data_key)
        self.seed = seed

    @cached_property
    def split(self) -> dict[str, IntArray]:
        """Rows of the randomly drawn joint samples, split by this seed."""
        settings, drawn = self.config.samples, np.flatnonzero(self.joint.index >= 0)
        return split(drawn, settings.test_fraction, settings.validation_fraction, np.random.default_rng(self.seed))


def variants(learner: Learner, some: dict[str, Variant]) -> dict[str, Any]:
    """Measure an ablation on the validation codes, so that recipes are not chosen by the test codes.

    Returns:
        ``variants``: title, R², bytes and ``closing`` of each. ``closing`` is the root mean square, in radians, by
        which the faces around a vertex fail to close. ``validation``: the same figures of the main recipe.
    """
    validation, composite = HeldOutSamples.of(learner, "validation"), learner.main()
    reference = learner.collection.reference
    conditions = Integrability(reference.connectivity)

    def figures(model: Composite) -> dict[str, Any]:
        predicted = validation.predicted(model)
        open_by = [np.square(conditions.at_vertices(z)).sum() for z in predicted.astype(np.float64)]
        return {
            "bytes": size_bytes(model),
            "closing": float(np.sqrt(np.mean(open_by) / max(1, len(conditions.vertices)))),
            "r2": validation.r2_of(predicted),
        }

    own = figures(composite)
    affine = affine_sum(nric(reference.vertices, reference.connectivity), validation.predicted(composite.factor_shapes))
    r2 = {"composite": own.pop("r2"), "affine of learned factors": validation.r2_of(affine)}
    return {
        "validation": {"samples": len(validation.rows), **own, "r2": r2},
        "variants": {
            name: {"title": some[name].title, **figures(learner.composite(recipe))}
            for name, recipe in recipes(learner.config.networks, some).items()
        },
    }


def fraction(learner: Learner, share: float) -> dict[str, Any]:
    """Measure networks that learn from a share of the training codes, on all test codes."""
    test = HeldOutSamples.of(learner)
    some, free = ShareLearner(learner, share), ShareLearner(learner, share, all_of_factors=True)
    result = {
        "fraction": share,
        "training_samples": len(some.rows["train"]),
        "derivatives": len(some.differentiated()[0]),
        "exponentials": {"composite": some.exponentials(), "all of factors": free.exponentials()},
        "r2": {
            "composite": test.r2(some.main()),
            "all of factors": test.r2(free.main()),
            "monolithic": test.r2(some.monolithic()),
            "kernel": test.r2(some.kernel()),
        },
    }
    learner.histories |= some.histories | free.histories
    return result


def other_seed(learner: Learner, seed: int) -> dict[str, Any]:
    """Measure networks of another seed, on the test codes of that seed's split."""
    other = SeedLearner(learner, seed)
    test = HeldOutSamples.of(other)
    r2 = {"composite": test.r2(other.main()), "monolithic": test.r2(other.monolithic())}
    r2["kernel"] = test.r2(other.kernel())
    learner.histories |= other.histories
    return {"seed": seed, "r2": r2}


def add(run: Run, studies: Studies) -> None:
    """Measure studies on a finished run, and add their figures and networks to its directory."""
    directory, learner, begun = run.directory, learner_of(run), time.monotonic()
    evaluation: dict[str, Any] = directory.evaluation.read()
    found: dict[str, Any] = {}
    if studies.variants:
        found |= variants(learner, studies.variants)
    if studies.fractions:
        found["fractions"] = [fraction(learner, share) for share in studies.fractions]
    if studies.seeds:
        found["seeds"] = [other_seed(learner, seed) for seed in studies.seeds]
    if not found:
        return
    # The stage `networks` keeps the files of networks that have a history.
    directory.histories.write(directory.histories.read() | learner.histories)
    directory.evaluation.write(evaluation | found)
    for name in ("networks", "evaluation"):
        remember(STAGES[name], directory)
    directory.log("end", stage="studies", seconds=round(time.monotonic() - begun, 3))
    write_report(directory)


def main() -> None:
    """Measure the chosen studies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run directory, finished up to evaluation")
    parser.add_argument("--variants", action="store_true", help="the ablation listed in studies.toml")
    parser.add_argument("--fractions", type=float, nargs="*", metavar="F", help="shares, or none for the listed ones")
    parser.add_argument("--seeds", type=int, nargs="*", metavar="S", help="seeds, or none for the listed ones")
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder of the run's bundle")
    given = parser.parse_args()
    studies = Studies.listed(given.run.resolve().name)
    if given.variants or given.fractions is not None or given.seeds is not None:
        studies = Studies(
            variants=studies.variants if given.variants else {},
            fractions=[] if given.fractions is None else given.fractions or studies.fractions,
            seeds=[] if given.seeds is None else given.seeds or studies.seeds,
        )
    if studies == Studies():
        parser.error(f"{LISTED.name} lists no such studies of {given.run.resolve().name}")
    config = given.run / "config.toml"
    run = Run(given.run, *load(config, stored=config), given.models)
    if not run.directory.evaluation.exists():
        parser.error(f"{given.run} has no evaluation.json: finish the run first")
    add(run, studies)


if __name__ == "__main__":
    main()
