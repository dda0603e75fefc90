"""Charts of a run's report: the course of training, modes, and factors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from numpy.typing import NDArray

from shapespace.training.report.plots import Line, lines, plot
from shapespace.training.report.record import HUES, Record


def mode_charts(record: Record) -> Iterator[tuple[str, Markup]]:
    """Plot the iterations of the SPGA, and the localisation of its modes."""
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


def overlap_chart(record: Record) -> Markup | None:
    """Show the overlap of the supports of modes, on average over the modes of two factors."""
    if not len(record.overlap):
        return None

    def draw(axes: Axes) -> None:
        axes.figure.colorbar(axes.imshow(record.overlap, cmap="magma_r", vmin=0), ax=axes)
        axes.set_xticks([])
        names = [factor.name for factor in record.factors]
        axes.set_yticks(range(len(names)), names, parse_math=False)
        axes.grid(visible=False)

    return plot("Overlap of the factors' supports", draw, size=(3.4, 2.7))


def loss_charts(record: Record) -> Iterator[tuple[str, Markup]]:
    """Plot losses by epoch. Networks of one kind share a plot; an ablation's variants are thin lines."""
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


def fraction_chart(record: Record) -> Markup | None:
    """Plot R² by the fraction of the samples that networks learned from."""
    rows = sorted(record.evaluation.get("fractions", []), key=lambda row: row["fraction"])
    if not rows:
        return None
    at = [row["fraction"] for row in rows]
    drawn = [
        Line(at, [row["r2"][model]["total"] for row in rows], hue, model, ".-")
        for model, hue in zip(rows[0]["r2"], HUES, strict=False)
    ]
    return lines("R² by the fraction of samples", "fraction of the samples", drawn)
