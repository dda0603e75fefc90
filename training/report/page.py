"""The report of a run: ``report.html``, one self-contained file of pictures, plots and tables."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.training.report.pictures import (
    CLAY,
    COMPOSITE,
    ERROR,
    MODE_REACH,
    NEUTRAL,
    Studio,
    colour_bar,
    ramp,
    tint,
)
from shapespace.training.report.plots import Line, lines, plot
from shapespace.training.report.record import HUES, Record
from shapespace.training.runs.atomic_files import NpzFile
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.stages import STAGES

#: Pixels of a picture's longer side. Pictures are shown at half that size or less, so that they are sharp on phones.
LARGE, SMALL = 480, 300
#: Most modes that are drawn.
MODES_SHOWN = 40
#: What the keys of R² in evaluation.json stand for.
MODELS = {
    "composite": "Composite network",
    "monolithic": "The same recipe with one factor",
    "kernel": "Kernel ridge regression on the codes",
    "monolithic_paper": "The paper's monolithic network",
    "paper": "The paper's composite network",
    "affine": "Affine sum of exact factors",
    "affine of learned factors": "Affine sum of learned factors",
    "grid": "Affine sum of multilinear grids",
}
#: Keys of evaluation.json with a section on the page; all others are listed in one table.
PLACED = {"eta", "test_samples", "r2", "r2_factors", "variants", "vertex_error", "sizes", "times", "fractions"}
PLACED |= {"compactness", "specificity", "prolongation", "generalisation", "fresh", "correction", "validation"}
#: What the kinds of corrections are called.
CORRECTIONS = {
    "kernel": "kernel ridge regression",
    "products": "products of two factors' coefficients",
    "convolutions": "graph convolutions",
    "field": "a perceptron at every edge",
}


def shapes(record: Record, studio: Studio) -> Iterator[tuple[Markup, str]]:
    """The mean and the reference, in both resolutions where there are two."""
    reference, faces = record.reference["vertices"], record.reference["faces"]
    if record.mean is not None:
        yield studio.draw(studio.base, "The mean shape", LARGE), "mean of the collection"
    aligned = align(reference, studio.base)
    if "fine_vertices" in record.reference:
        # The motion of the coarse reference, found as the affine map that it is, moves the fine one too.
        motion = np.linalg.lstsq(np.c_[reference, np.ones(len(reference))], aligned)[0]
        fine, fine_faces = record.reference["fine_vertices"], record.reference["fine_faces"]
        moved = np.c_[fine, np.ones(len(fine))] @ motion
        picture = studio.draw(moved, "The reference mesh", LARGE, faces=fine_faces)
        yield picture, f"reference as it came, {len(fine):,} vertices"
    elif record.mean is None:
        yield studio.draw(aligned, "The reference mesh", LARGE), "reference"
    picture = studio.draw(aligned, "The reference mesh, its triangles visible", LARGE, smooth=False)
    yield picture, f"reference to compute with, {len(reference):,} vertices and {len(faces):,} faces"


def mode_cards(record: Record, studio: Studio) -> Iterator[dict[str, Any]]:
    """For each index the SPGA mode beside the PGA mode, moved along it and coloured by its support."""
    modes = record.modes
    factor_of = {i: factor for factor in record.factors for i in factor.modes}
    kinds = [(kind, prefix) for kind, prefix in (("SPGA", ""), ("PGA", "pga_")) if f"{prefix}vertices" in modes]
    support = {kind: record.supports(modes[f"{prefix}nric"]) for kind, prefix in kinds}
    reach = MODE_REACH * diagonal(studio.base)
    for i in range(min(len(modes["vertices"]), MODES_SHOWN)):
        title, factor = f"Mode {i}", factor_of.get(i)
        pictures = []
        for kind, prefix in kinds:
            if i < len(support[kind]):
                field = modes[f"{prefix}vertices"][i]
                moved = studio.base + reach / np.linalg.norm(field, axis=1).max().clip(1e-300) * field
                colours = tint(ramp(factor.hue if factor and kind == "SPGA" else NEUTRAL), support[kind][i])
                local = modes.get(f"{prefix}localisation")
                caption = kind if local is None else f"{kind} · {local[i]:.2f}"
                pictures.append((studio.draw(moved, f"{title} of {kind} by its support", SMALL, colours), caption))
        yield {"title": title, "factor": factor, "pictures": pictures}


def mode_plots(record: Record) -> Iterator[tuple[str, Markup]]:
    """The course of the SPGA, and how local its modes are."""
    history = record.decomposition.get("history", [])
    for key in ("objective", "support") if history else ():
        line = Line([step["iteration"] for step in history], [step[key] for step in history], HUES[1])
        yield f"SPGA: {key}", lines(f"{key} of the SPGA by iteration", "iteration", [line])
    if "localisation" in record.modes:
        rows = [
            Line(np.arange(len(y)), y, hue, kind, ".")
            for kind, y, hue in (
                ("SPGA", record.modes["localisation"], HUES[0]),
                ("PGA", record.modes["pga_localisation"], HUES[1]),
            )
        ]
        yield "Localisation", lines("Localisation by mode, SPGA and PGA", "mode", rows)


def factor_cards(record: Record, studio: Studio | None) -> Iterator[dict[str, Any]]:
    """Each factor by the support of its modes, and before them all factors in one picture."""
    pictures: list[Markup | None] = [None] * len(record.factors)
    if studio and "nric" in record.modes and record.factors:
        each = record.supports(record.modes["nric"])
        support = np.array([each[factor.modes].max(axis=0, initial=0) for factor in record.factors])
        for j, factor in enumerate(record.factors):
            colours = tint(ramp(factor.hue), support[j])
            pictures[j] = studio.draw(studio.base, f"Support of {factor.name}", SMALL, colours)
        share, strength = support**4 / (support**4).sum(axis=0).clip(1e-300), support.max(axis=0)[:, None]
        mixed = share.T @ np.array([to_rgb(factor.hue) for factor in record.factors])
        colours = (1 - strength) * to_rgb(CLAY) + strength * mixed
        yield {"factor": None, "picture": studio.draw(studio.base, "All factors, each in its colour", SMALL, colours)}
    for factor, picture in zip(record.factors, pictures, strict=True):
        yield {"factor": factor, "picture": picture}


def overlap_plot(record: Record) -> Markup | None:
    """How much the supports of modes have in common, on average over the modes of two factors."""
    if not len(record.overlap):
        return None

    def draw(axes: Axes) -> None:
        axes.figure.colorbar(axes.imshow(record.overlap, cmap="magma_r", vmin=0), ax=axes)
        axes.set_xticks([])
        names = [factor.name for factor in record.factors]
        axes.set_yticks(range(len(names)), names, parse_math=False)
        axes.grid(visible=False)

    return plot("Overlap of the factors' supports", draw, size=(3.4, 2.7))


def loss_plots(record: Record) -> Iterator[tuple[str, Markup]]:
    """Losses by epoch; networks of the same kind, of the ablation's variants, are thin lines in the same plot."""
    kinds: dict[str, list[NDArray]] = {}
    for stem, state in record.histories.items():
        if state.get("history"):
            kinds.setdefault(stem.rpartition("-")[0] or stem, []).append(np.array(state["history"], dtype=float))
    for kind, runs in kinds.items():
        title = kind
        if (index := kind.removeprefix("factor-")).isdecimal() and int(index) < len(record.factors):
            title = record.factors[int(index)].name
        rows = [Line(np.arange(1, len(h) + 1), h[:, 1], "#8792a0", alpha=0.5) for h in runs[1:]]
        epochs, (train, validation) = np.arange(1, len(runs[0]) + 1), runs[0].T
        best = int(np.argmin(np.where(np.isfinite(validation), validation, np.inf)))
        rows += [
            Line(epochs, train, HUES[1], "training"),
            Line(epochs, validation, HUES[0], "validation"),
            Line(epochs[[best]], validation[[best]], HUES[0], style="o"),
        ]
        yield title, lines(f"Losses of {title} by epoch", "epoch", rows, log=True)


def extremes(record: Record, studio: Studio) -> dict[str, Any] | None:
    """The best, the median and the worst shape of the test split, errors on one logarithmic scale of two decades."""
    gallery = record.gallery
    if not {"test_exact", "test_predicted", "test_error"} <= gallery.keys():
        return None
    error = gallery["test_error"]
    top = max(float(error.max()), 1e-12)
    rows = []
    for k, title in enumerate(("Best", "Median", "Worst")[: len(error)]):
        exact = align(gallery["test_exact"][k], studio.base)
        colours = tint(ERROR, 1 + np.log10(error[k].clip(1e-300) / top) / 2)
        predicted = align(gallery["test_predicted"][k], exact)
        alt = f"{title} test shape as the network has it, by its error"
        rows.append({
            "title": title,
            "number": int(gallery["test_index"][k]) if "test_index" in gallery else None,
            "exact": studio.draw(exact, f"{title} test shape, exact", LARGE),
            "predicted": studio.draw(predicted, alt, LARGE, colours),
            "mean": float(error[k].mean()),
            "max": float(error[k].max()),
        })  # fmt: skip
    return {"rows": rows, "bar": colour_bar(ERROR, *(percent(top * x) for x in (0.01, 0.1, 1)))}


def nearness(record: Record, studio: Studio | None) -> list[dict[str, Any]]:
    """How near the space comes to the user's own shapes, unseen and learned from, each with its worst in a picture."""
    kinds = []
    if (facts := record.generalisation) and "failed" not in facts:
        kinds.append({
            "title": "Shapes it has not seen",
            "how": f"{facts['held_out']} shapes, held out while mean and modes were found; exponentials, no networks"
            + (f"; for {facts['stuck']} the search did not end: faces collapse" if facts.get("stuck") else ""),
            "figures": [
                (f"{count:.3g} coordinates", of, components)
                for count, of, components in zip(facts["counts"], facts["modes"], facts["components"], strict=True)
            ]
            + others(facts),
            "worst": facts["worst"],
            "pictures": _pair(record.run.least_general, facts["worst"], studio),
        })  # fmt: skip
    if facts := record.encoded:
        modes = facts.get("modes")
        kinds.append({
            "title": "Shapes it has learned from",
            "how": f"all {facts['shapes']}, through encode as it is served"
            + (", where what it missed of them is remembered" if facts.get("remembered") else ""),
            "figures": [
                ("as served", facts, facts["components"]),
                *([("modes alone, no networks", modes, facts["components"])] if modes else []),
            ],
            "worst": facts["worst"],
            "pictures": _pair(record.run.least_near, facts["worst"], studio),
        })  # fmt: skip
    return kinds


def others(facts: dict[str, Any]) -> list[tuple[str, dict[str, float], dict[str, float]]]:
    """Of held-out shapes those whose search ended, where it did not for some: networks go on where it stops."""
    if not facts.get("stuck") or not facts["not_stuck"]:
        return []
    some, count = facts["not_stuck"], facts["held_out"] - facts["stuck"]
    return [(f"where it ended ({count})", some["modes"], some["components"])]


def qualities(record: Record) -> list[tuple[str, str, str]]:
    """Compactness and specificity, of modes and of components, where they are known."""
    rows = [
        ("compactness", 4, "variance of your shapes that is explained (compactness)"),
        ("specificity", 2, "from random shapes to the nearest of yours (specificity)"),
    ]
    found = record.evaluation
    return [
        (title, percent(found[name]["modes"], digits), percent(found[name]["components"], digits))
        for name, digits, title in rows
        if name in found
    ]


def _pair(file: NpzFile, title: str, studio: Studio | None) -> list[tuple[Markup, str]]:
    """A shape and what was found for it, where there are any."""
    shapes = file.read_if_written() if studio else {}
    return [
        (studio.draw(align(shapes[name], studio.base), f"{title}, {name}", LARGE), name)
        for name in ("given", "found")
        if studio and name in shapes
    ]


def strip(record: Record, studio: Studio) -> Iterator[tuple[str, str, Markup]]:
    """An interpolation: the joint shapes, and below them each factor's own element (paper, figure of SCAPE)."""
    gallery = record.gallery
    if "strip_joint" in gallery:
        joint = align(gallery["strip_joint"], studio.base)
        yield "Together", COMPOSITE, studio.draw(joint, "The interpolation, frame by frame", SMALL, COMPOSITE)
    for j, frames in enumerate(gallery.get("strip_factors", ())):
        name, hue = f"Factor {j}", HUES[j % len(HUES)]
        if j < len(record.factors):
            name, hue = record.factors[j].name, record.factors[j].hue
        frames = align(frames, studio.base)
        moved = np.linalg.norm(frames - studio.base, axis=-1)
        colours = tint(ramp(hue), moved / max(float(moved.max()), 1e-300))
        yield name, hue, studio.draw(frames, f"The part of {name}, frame by frame", SMALL, colours)


def fraction_plot(record: Record) -> Markup | None:
    """R² by the fraction of the samples that was learned from."""
    rows = sorted(record.evaluation.get("fractions", []), key=lambda row: row["fraction"])
    if not rows:
        return None
    at = [row["fraction"] for row in rows]
    drawn = [
        Line(at, [row["r2"][model]["total"] for row in rows], hue, model, ".-")
        for model, hue in zip(rows[0]["r2"], HUES, strict=False)
    ]
    return lines("R² by the fraction of samples", "fraction of the samples", drawn)


def joined(correction: dict[str, Any]) -> str:
    """How factors are joined, and why so."""
    kind, tried = correction["kind"], correction.get("tried", {})
    sentence = f"Factors are joined by {CORRECTIONS.get(kind, kind)}"
    if kind not in tried:
        return f"{sentence}, as the configuration says."
    sentence += f", which leaves {percent(tried[kind])} of the shapes' mean square on held-out codes"
    others = [f"{CORRECTIONS.get(each, each)} {percent(left)}" for each, left in tried.items() if each != kind]
    if others:
        return f"{sentence}; {', '.join(others)}."
    return f"{sentence}. Nothing else was tried, as nothing wanders over the surface or this took long."


def flatten(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Figures without a section of their own, each with its path."""
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from flatten(inner, f"{name} · {key}" if name else str(key))
    else:
        yield name, value


def figure(value: Any) -> str:
    """Four digits of a number, anything else as it stands."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return "–" if not math.isfinite(value) else f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def r2(value: float | None) -> str:
    """Four decimals."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4f}"


def percent(value: float, digits: int = 2) -> str:
    """So many digits of a percentage."""
    return f"{100 * value:.{digits}g}\N{NO-BREAK SPACE}%"


def duration(seconds: float | None) -> str:
    """Seconds in the unit that suits them."""
    if seconds is None or not math.isfinite(seconds):
        return "–"
    if seconds < 0.9995:
        return f"{1000 * seconds:.3g}\N{NO-BREAK SPACE}ms"
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g}\N{NO-BREAK SPACE}{unit}"
    return f"{seconds:.3g}\N{NO-BREAK SPACE}s"


def size(value: float) -> str:
    """Bytes, in megabytes."""
    return f"{value / 1e6:.3g}\N{NO-BREAK SPACE}MB"


def page(record: Record) -> str:
    """The whole page of a run."""
    studio = Studio.of(record)
    close = studio and studio.closer(record.reference["vertices"])
    figures = record.evaluation
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
        nearness=nearness(record, close or None),
        qualities=qualities(record),
        stages=list(STAGES),
        pictures=studio is not None,
        shapes=list(shapes(record, close)) if close else [],
        modes=list(mode_cards(record, close)) if close and modes else [],
        modes_count=len(modes.get("vertices", ())),
        mode_plots=list(mode_plots(record)),
        explained={
            kind: record.decomposition[key]
            for kind, key in (("SPGA", "explained"), ("PGA", "pga_explained"))
            if key in record.decomposition
        },
        support_bar=colour_bar(ramp(NEUTRAL), "unchanged", "changes most"),
        factors=list(factor_cards(record, close)),
        overlap=overlap_plot(record),
        losses=list(loss_plots(record)),
        longest=max((seconds for seconds in record.seconds.values() if seconds), default=1.0),
        tests=extremes(record, studio) if studio else None,
        strip=list(strip(record, studio)) if studio else [],
        evaluation=figures,
        models=MODELS,
        fractions=fraction_plot(record),
        joined=joined(figures["correction"]) if "correction" in figures else "",
        others=list(flatten({key: value for key, value in figures.items() if key not in PLACED})),
    )


def write_report(run: RunDirectory) -> Path:
    """Write ``report.html`` from what a run, finished or not, has left in its directory; returns its path.

    Raises:
        ReportError: the folder is no run directory, or a file in it can't be read.
    """
    run.report.write(page(Record(run)))
    return run.report.path
