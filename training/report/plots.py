"""Plots as SVG elements that inherit the page's font and colours."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike

#: Placeholder for the page's text colour, light or dark; the SVG has ``currentColor`` instead.
INK = "#010203"
STYLE: dict[Any, Any] = {
    "axes.edgecolor": INK, "axes.labelcolor": INK, "axes.linewidth": 0.6, "axes.spines.right": False,
    "axes.spines.top": False, "axes.grid": True, "font.size": 8, "grid.alpha": 0.15, "grid.color": INK,
    "grid.linewidth": 0.5, "legend.frameon": False, "legend.labelcolor": INK, "lines.linewidth": 1.3,
    "svg.fonttype": "none", "text.color": INK, "text.parse_math": False, "xtick.color": INK, "ytick.color": INK,
}  # fmt: skip


def plot(alt: str, draw: Callable[[Axes], Any], size: tuple[float, float] = (3.5, 2.2)) -> Markup:
    """Return an SVG element.

    Args:
        alt: alternative text for screen readers.
        draw: draws into the axes.
        size: width and height in inches, which fixes the size of text relative to the plot.
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
