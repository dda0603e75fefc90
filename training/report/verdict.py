"""Verdict of a report: how good the model is in one sentence, and what would make it better."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from shapespace.training.report.cards import MAPS, SIMPLE, coordinates
from shapespace.training.report.number_format import percent
from shapespace.training.report.record import Record

#: Errors that differ by less than this share count as equal.
EQUAL = 0.05
#: PCA is named instead of a better simple model if its error is larger by less than this share.
SAME = 0.01
#: More coordinates are advised if the last half of them removed at least this share of the unseen error.
STILL_FALLS = 0.15
#: More samples are advised if the networks' error is more than this share of the unseen error.
NETWORKS = 0.3
#: More shapes are advised if training shapes have at most this share of the unseen error.
LEARNED = 0.6
#: Below this mean error on unseen shapes, as a share of the diagonal, nothing is advised.
NEGLIGIBLE = 1e-4
#: Without comparisons, a model is good up to this mean vertex error, as a share of the diagonal.
GOOD = 0.005


def verdict(record: Record) -> str:
    """Return one sentence on the accuracy of the model; empty if nothing was measured yet."""
    unseen = _unseen(record)
    if not unseen:
        error = record.evaluation.get("vertex_error", {}).get("mean")
        if error is None:
            return ""
        good = "accurately" if error <= GOOD else "roughly"
        return f"The networks reproduce exact shapes {good}, with a mean error of {percent(error)} of the diagonal."
    own, rival = unseen["modes"], _strongest(unseen)
    sentence = f"The model reproduces unseen shapes with a mean error of {percent(own)} of the diagonal"
    ratio = own / unseen[rival]
    than = "less" if ratio < 1 else "more"
    beside = (
        f"{ratio:.2g} times as large as by the best simple model"
        if ratio >= 2
        else "about as well as the best simple model"
        if abs(1 - ratio) < EQUAL
        else f"{percent(abs(1 - ratio))} {than} than the best simple model"
    )
    return f"{sentence}, {beside} ({SIMPLE[rival]}).{_by_another_map(record)}"


def _by_another_map(record: Record) -> str:
    """Say so if the unseen shapes were left out of a model with another map."""
    others = [each for each in record.generalisation.get("maps", ()) if each != record.map]
    if not others:
        return ""
    words = " or ".join(MAPS[each] for each in others)
    return f" This is the error of {words}: without these shapes, the run chose another map than for your model."


def advice(record: Record) -> Iterator[str]:
    """Yield sentences on what to change, the most useful first."""
    unseen, facts = _unseen(record), record.generalisation
    if not unseen or unseen["modes"] < NEGLIGIBLE:
        return
    own, rival = unseen["modes"], _strongest(unseen)
    compared = record.geometry.get("errors")
    if own > (1 + EQUAL) * unseen[rival] and not compared:
        yield (
            f"Another map: the error by {SIMPLE[rival]} is {percent(unseen[rival])}. Set modes.geometry to "
            '"auto", which compares maps from codes to shapes.'
        )
    half, shapes = facts["modes"][-2]["mean"] if len(facts["modes"]) > 1 else own, _shapes(record)
    # "auto" has stopped where more modes help little.
    given_count = record.config.get("modes", {}).get("count", "auto")
    room = given_count != "auto" and 1.5 * given_count < 0.8 * shapes
    if own < (1 - STILL_FALLS) * half and room:
        fewer, more = facts["counts"][-2:]
        yield (
            f"More modes: with {coordinates(more)} instead of {fewer:g}, the error on unseen shapes fell from "
            f"{percent(half)} to {percent(own)}. Try modes.count = {round(1.5 * given_count)}."
        )
    error = record.evaluation.get("vertex_error", {}).get("mean", 0.0)
    if record.map == "exponential" and error > NETWORKS * own:
        given = record.config.get("samples", {}).get("count", 4000)
        yield f"More samples: the networks add {percent(error)}. Try samples.count = {2 * given}."
    trained = record.encoded.get("modes") or {}
    if shapes and trained.get("mean", own) < LEARNED * own:
        missed = percent(trained["mean"])
        yield (
            f"More shapes: the modes miss the {shapes} training shapes by {missed}, and unseen shapes by "
            f"{percent(own)}. Add shapes that differ from yours."
        )


def _unseen(record: Record) -> dict[str, float]:
    """Return the mean error on unseen shapes by model, with all coordinates; empty if it was not measured."""
    facts: Mapping[str, Any] = record.generalisation
    if "failed" in facts or "modes" not in facts:
        return {}
    return {name: facts[name][-1]["mean"] for name in SIMPLE if name in facts}


def _strongest(errors: Mapping[str, float]) -> str:
    """Return the name of the best simple model, or the simplest of those that are as good."""
    best = min((name for name in errors if name != "modes"), key=lambda name: errors[name])
    return "components" if errors["components"] <= (1 + SAME) * errors[best] else best


def _shapes(record: Record) -> int:
    return int(record.encoded.get("shapes") or len(record.modes.get("coefficients", ())))
