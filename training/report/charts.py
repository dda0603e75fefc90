"""Charts of a run's report, as SVG elements that inherit the page's font and colours."""

import io
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from shapespace.training.report.record import HUES, Record

#: Placeholder for the page's text colour, light or dark; the SVG has ``currentColor`` instead.
INK = "#010203"
STYLE: dict[Any, Any] = {
    "axes.edgecolor": INK, "axes.labelcolor": INK, "axes.linewidth": 0.6, "axes.spines.right": False,
    "axes.spines.top": False, "axes.grid": True, "font.size": 8, "grid.alpha": 0.15, "grid.color": INK,
    "grid.linewidth": 0.5, "legend.frameon": False, "legend.labelcolor": INK, "lines.linewidth": 1.3,
    "svg.fonttype": "none", "text.color": INK, "text.parse_math": False, "xtick.color": INK, "ytick.color": INK,
}  # fmt: skip


def plot(alt: str, draw: Callable[[Axes], Any], size: tuple[float, float] = (3.5, 2.2)) -> Markup:
    """Return an SVG element. Width and height in inches fix the size of text relative to the plot. Screen readers read
    ``alt``.
    """
    file = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": alt}):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure.subplots())
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=nothing)
    svg = file.getvalue()
    # Remove the XML prologue, the fixed size, addresses of namespaces, and ids that repeat from plot to plot. Ids with
    # references stay. They are hashes with ``alt`` as salt, so they differ between plots.
    svg = re.sub(r'^.*?<svg .*?(viewBox="[^"]*").*?>', r" \1>", svg, count=1, flags=re.DOTALL)
    svg = re.sub(r' id="[a-zA-Z0-9.]+_\d+"', "", svg).replace(INK, "currentColor")
    rest = Markup(svg.rstrip())  # noqa: S704 - matplotlib has escaped the texts in it
    return Markup('<svg role="img" aria-label="{}"{}').format(alt, rest)


@dataclass(frozen=True)
class Line:
    """A line of a plot; without a name it isn't in the legend."""

    x: ArrayLike
    y: ArrayLike
    colour: str
    name: str = ""
    style: str = "-"
    alpha: float = 1.0


def lines(alt: str, label: str, rows: Sequence[Line], *, log: bool = False, **axis: Any) -> Markup:
    """Plot lines over an axis with a label; ``axis`` holds arguments for matplotlib's ``Axes.set``."""

    def draw(axes: Axes) -> None:
        for line in rows:
            axes.plot(line.x, line.y, line.style, color=line.colour, alpha=line.alpha, label=line.name or None)
        axes.set(xlabel=label, yscale="log" if log else "linear", **axis)
        whole = all(np.array_equal(np.asarray(line.x), np.round(np.asarray(line.x))) for line in rows)
        axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=whole))
        if log:
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        if any(line.name for line in rows):
            axes.legend()

    return plot(alt, draw)


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
                (record.mode_kind, record.modes["localisation"], HUES[0]),
                ("PGA", record.modes.get("pga_localisation"), HUES[1]),
            )
            if y is not None
        ]
        kinds = " and ".join(row.name for row in rows)
        yield "Localisation", lines(f"Localisation by mode, {kinds}", "mode", rows)


def overlap_chart(record: Record) -> Markup | None:
    """Show the overlap of the supports of modes, on average over the modes of two factors."""
    if len(record.overlap) < 2:
        return None

    def draw(axes: Axes) -> None:
        axes.figure.colorbar(axes.imshow(record.overlap, cmap="magma_r", vmin=0), ax=axes)
        axes.set_xticks([])
        names = [factor.name for factor in record.factors]
        axes.set_yticks(range(len(names)), names, parse_math=False)
        axes.grid(visible=False)

    return plot("Overlap of the factors", draw, size=(3.4, 2.7))


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
    return lines("R² by share of the samples", "share of the samples", drawn)
