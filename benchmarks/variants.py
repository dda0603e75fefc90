"""Variants of a run's recipe of networks, the rows of an ablation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict

from shapespace.training.runs.network_settings import Recipe


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
