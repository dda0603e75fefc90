"""The pages in docs/measurements: their folder, their templates, and their tables in Markdown."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jinja2

ROOT = Path(__file__).resolve().parents[1]
MEASUREMENTS = ROOT / "docs" / "measurements"


def write(name: str, text: str) -> None:
    """Write the page ``docs/measurements/NAME.md``."""
    (MEASUREMENTS / f"{name}.md").write_text(text, encoding="utf-8")


def render(name: str, **values: Any) -> str:
    """Render the template ``benchmarks/NAME.md.jinja``."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # noqa: S701 - Markdown of our own
    )
    environment.filters["percent"] = lambda share, digits=2: f"{100 * share:.{digits}f} %"
    return environment.get_template(f"{name}.md.jinja").render(**values)


def row(cells: Iterable[str]) -> str:
    """Return a row of a table."""
    return f"| {' | '.join(cells)} |"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, without a newline at its end."""
    return "\n".join(map(row, (head, ["---"] * len(head), *rows)))
