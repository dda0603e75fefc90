"""The report of a run: ``report.html``, one self-contained file of pictures, charts and tables."""

from collections import Counter
from pathlib import Path
from typing import Any

import jinja2

from shapespace.counted import counted
from shapespace.training.report.cards import (
    MAPS,
    accuracy_cards,
    extreme_shapes,
    factor_cards,
    interpolation_strips,
    mode_cards,
    random_shapes,
    shape_pictures,
)
from shapespace.training.report.charts import fraction_chart, loss_charts, mode_charts, overlap_chart
from shapespace.training.report.number_format import duration, figure, flatten, percent, r2, size
from shapespace.training.report.pictures import NEUTRAL, Studio, colour_bar, ramp
from shapespace.training.report.record import Record
from shapespace.training.report.verdict import advice, verdict
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.stages.run import STAGES

#: Titles of the models in ``r2`` of evaluation.json.
MODELS = {
    "composite": "Composite network",
    "monolithic": "The same recipe with one factor",
    "kernel": "Kernel ridge regression on the codes",
    "monolithic_paper": "The paper's monolithic network",
    "paper": "The paper's composite network, sizes chosen here",
    "affine": "Affine sum of exact factors",
    "affine of learned factors": "Affine sum of learned factors",
    "grid": "Affine sum of multilinear grids",
}
#: Keys of evaluation.json with a section on the page; one table lists all other keys.
PLACED = {"eta", "test_samples", "r2", "r2_factors", "variants", "vertex_error", "sizes", "times", "fractions"}
PLACED |= {
    "compactness",
    "specificity",
    "prolongation",
    "generalisation",
    "fresh",
    "limit",
    "made_by",
    "correction",
    "validation",
}
#: Keys of evaluation.json that say how well networks follow exact shapes.
OF_NETWORKS = {
    "r2",
    "r2_factors",
    "fresh",
    "limit",
    "correction",
    "variants",
    "validation",
    "affine_samples",
    "vertex_error",
}
#: Other keys of evaluation.json, in words.
WORDS = {
    "affine_samples": "test codes of the affine sums",
    "exponentials": "exact shapes that training computed",
    "derivatives": "of which with derivatives",
}
#: Descriptions of the kinds of corrections.
CORRECTIONS = {
    "kernel": "kernel ridge regression",
    "products": "products of two factors' coefficients",
    "sum": "their sum alone",
    "convolutions": "graph convolutions",
    "field": "a perceptron at every edge",
}


def write_report(run: RunDirectory) -> Path:
    """Write ``report.html`` from the files of a run, finished or not, and return its path. Raises ReportError if the
    folder is no run directory, or a file in it can't be read.
    """
    run.report.write(page(Record(run)))
    return run.report.path


def page(record: Record) -> str:
    """Return the HTML of a run's report."""
    studio = Studio.of(record)
    close = studio and studio.closer(record.reference["vertices"])
    figures, straight = record.evaluation, record.map != "exponential"
    if straight:  # exact but for rounding
        figures = {name: value for name, value in figures.items() if name not in OF_NETWORKS}
    export = record.config.get("export", {})
    modes = record.modes if {"vertices", "nric"} <= record.modes.keys() else {}
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figure": figure, "r2": r2, "percent": percent, "duration": duration, "bytes": size}
    return environment.get_template("report.jinja").render(
        title=export.get("title") or record.run.folder.resolve().name,
        description=export.get("description", ""),
        record=record,
        verdict=verdict(record),
        advice=list(advice(record)),
        served=bool(record.seconds.get("export")),
        accuracy=accuracy_cards(record, close or None),
        qualities=_qualities(record),
        geometry=" ".join(filter(None, (_geometry(record.geometry), _local(record)))),
        stages=list(STAGES),
        pictures=studio is not None,
        shapes=list(shape_pictures(record, close)) if close else [],
        modes=list(mode_cards(record, close)) if close and modes else [],
        modes_count=len(modes.get("vertices", ())),
        mode_charts=list(mode_charts(record)),
        explained={
            kind: record.decomposition[f"{prefix}explained"]
            for kind, prefix in (("these modes" if straight else "SPGA", ""), ("PGA", "pga_"))
            if f"{prefix}explained" in record.decomposition and f"{prefix}vertices" in modes
        },
        support_bar=colour_bar(ramp(NEUTRAL), "unchanged", "changes most"),
        factors=list(factor_cards(record, close)),
        overlap=overlap_chart(record),
        losses=list(loss_charts(record)),
        recipes=max(Counter(stem.rpartition("-")[0] for stem in record.histories).values(), default=1),
        longest=max((seconds for seconds in record.seconds.values() if seconds), default=1.0),
        straight=straight,
        random=random_shapes(record, studio) if studio else [],
        tests=extreme_shapes(record, studio) if studio and not straight else None,
        strips=list(interpolation_strips(record, studio)) if studio and not straight else [],
        evaluation=figures,
        models=MODELS,
        fractions=fraction_chart(record),
        correction=_correction(figures["correction"]) if "correction" in figures else "",
        others=list(flatten({WORDS.get(key, key): value for key, value in figures.items() if key not in PLACED})),
    )


def _qualities(record: Record) -> list[tuple[str, str, str]]:
    """Return rows of compactness and specificity, for modes and for components, as far as they are known."""
    rows = [
        ("compactness", 4, "explained variance of your shapes (compactness)"),
        ("specificity", 2, "mean distance from random shapes to the nearest of yours (specificity)"),
    ]
    found = record.evaluation
    return [
        (title, percent(found[name]["modes"], digits), percent(found[name]["components"], digits))
        for name, digits, title in rows
        if name in found
    ]


def _geometry(choice: dict[str, Any]) -> str:
    """Return sentences on the map from codes to shapes, and what it gains; empty where nothing was chosen."""
    if not choice:
        return ""
    kind, errors = choice["kind"], choice["errors"]
    sentence = f"Codes make shapes by {MAPS[kind]}"
    if not errors:
        return f"{sentence}."
    others = [f"{percent(error, 3)} by {MAPS[each]}" for each, error in errors.items() if each != kind]
    found = (
        f"{sentence}. To choose the map, the run left {counted(choice['held_out'], 'shape')} out in turn. With "
        f"{counted(choice['compared'], 'coordinate')}, their error was {percent(errors[kind], 3)}"
    )
    if not others:
        return f"{found}. The other maps had no mean shape."
    beside = " and ".join(filter(None, (", ".join(others[:-1]), others[-1])))
    return (
        f"{found}, beside {beside}. A cheaper map is taken if its error is at most 2 % above the best "
        "straight line, and at most 5 % above exponentials. The errors below are of other left-out shapes."
    )


def _local(record: Record) -> str:
    """Return a sentence on modes that move single regions; empty where there are none."""
    if not record.decomposition.get("local_share"):
        return ""
    gain = record.geometry.get("local_gain", 0.0)
    lowered = f" On left-out shapes this lowers the error by {percent(gain, 1)}." if gain > 0 else ""
    return (
        "An unseen shape may do in one region what one of your shapes does, and elsewhere what another does. So some "
        f"coordinates move single regions.{lowered}"
    )


def _correction(correction: dict[str, Any]) -> str:
    kind, tried = correction["kind"], correction.get("tried", {})
    sentence = f"The factors are joined by {CORRECTIONS.get(kind, kind)}"
    if kind not in tried:
        return f"{sentence}, as the configuration says."
    sentence += f". Its error on held-out codes is {percent(tried[kind])} of the shapes' mean square"
    others = [f"{CORRECTIONS.get(each, each)} {percent(left)}" for each, left in tried.items() if each != kind]
    if others:
        return f"{sentence}. For comparison: {', '.join(others)}."
    return f"{sentence}. No other kind was tried."
