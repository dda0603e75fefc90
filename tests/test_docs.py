"""Links, tests and pages that the documentation names exist."""

import re
import tomllib
from collections import defaultdict
from pathlib import Path

import pytest
import yaml

from tests.long.__main__ import BEGIN, END, RECORD, TESTS, recorded

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md")), ROOT / "benchmarks" / "NOTES.md"]
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def text_of(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub names them."""
    headings = re.findall(r"^#+ (.*)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in LINK.findall(text_of(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert target.is_relative_to(ROOT), link
        if anchor:
            assert anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_tests_that_are_named_are_there(page: Path) -> None:
    for name, case in re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", page.read_text(encoding="utf-8")):
        assert (ROOT / name).exists(), name
        assert not case or f"def {case}" in (ROOT / name).read_text(encoding="utf-8"), case


@pytest.mark.parametrize("page", [name for name in NAMES if "/measurements/" in name or "is-it" in name])
def test_tables_for_readers_have_at_most_five_columns(page: str) -> None:
    rows = re.findall(r"^\|[-| :]+\|$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert all(row.count("|") <= 6 for row in rows)


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert [citation[key] for key in ("title", "version", "license")] == [
        project[key] for key in ("name", "version", "license")
    ]
    assert citation["authors"][0]["name"] in (ROOT / "LICENSE").read_text(encoding="utf-8")


def test_the_workflow_runs_what_people_run() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))["jobs"]
    assert {"run": ".ci/run"} in jobs["suite"]["steps"]
    assert set(jobs["wheel"]["strategy"]["matrix"]["os"]) == {"ubuntu-latest", "macos-latest", "windows-latest"}


def test_every_long_test_is_listed_with_its_folders() -> None:
    table = text_of(ROOT / "CONTRIBUTING.md").partition("## Long tests")[2].partition("\n## ")[0]
    told = defaultdict(set)
    for row in re.findall(r"^\| (`.*`) \| (`.*`) \|$", table, re.MULTILINE):
        folders, names = (re.findall("`([^`]+)`", cell) for cell in row)
        for name in names:
            told[name] |= {folder.rstrip("/") for folder in folders}
    assert told == {name: set(test.folders) for name, test in TESTS.items()}
    assert all((ROOT / folder).exists() for test in TESTS.values() for folder in test.folders)


def test_the_record_of_long_tests_has_tests_that_are_there() -> None:
    assert all(RECORD.read_text(encoding="utf-8").count(mark) == 1 for mark in (BEGIN, END))
    assert recorded().keys() <= TESTS.keys()


def test_the_site_has_every_page() -> None:
    def listed(entry: object) -> list[str]:
        inside = entry.values() if isinstance(entry, dict) else entry
        return [entry] if isinstance(entry, str) else [page for part in inside for page in listed(part)]

    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    pages = [name.removeprefix("docs/") for name in NAMES if name.startswith("docs/")]
    assert sorted(listed(site["nav"])) == pages
