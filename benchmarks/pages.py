"""The pages in docs/measurements: their folder, templates and tables, and the files of figures that they show."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jinja2

from shapespace.training.report.number_format import r2, short_of
from shapespace.training.runs.provenance import MADE_BY, made_by

ROOT = Path(__file__).resolve().parents[1]
MEASUREMENTS = ROOT / "docs" / "measurements"


def read_figures(file: Path) -> Any:
    """Read the figures of a file in ``runs``: a mapping, or a list of rows."""
    found = json.loads(file.read_text(encoding="utf-8"))
    return found["rows"] if found.keys() == {MADE_BY, "rows"} else found


def measured_with(*files: Path) -> str:
    """Say in a sentence after which versions of shapespace some files of figures were made."""
    versions = {json.loads(file.read_text(encoding="utf-8"))[MADE_BY]["version"] for file in files}
    return f"Measured with the code after version {' and '.join(sorted(versions))}."


def listed(words: list[str]) -> str:
    """Return a list in words: ``a, b and c``."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)


def write_figures(file: Path, found: dict[str, Any] | list[Any]) -> None:
    """Write a mapping or a list of rows to a file in ``runs``, with what made it."""
    file.parent.mkdir(exist_ok=True)
    facts = {MADE_BY: made_by()} | (found if isinstance(found, dict) else {"rows": found})
    file.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


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
    environment.filters["r2"] = r2
    environment.filters["short_of"] = short_of
    environment.filters["percent"] = lambda share, digits=2: f"{100 * share:.{digits}f} %"
    return environment.get_template(f"{name}.md.jinja").render(**values)


def row(cells: Iterable[str]) -> str:
    """Return a row of a table."""
    return f"| {' | '.join(cells)} |"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, without a newline at its end."""
    return "\n".join(map(row, (head, ["---"] * len(head), *rows)))
