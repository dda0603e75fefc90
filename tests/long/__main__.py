"""Run tests that take minutes to hours, and record when each last passed: ``python -m tests.long [NAME …]``.

Without a name it lists the tests, what each does, and how many commits have changed its folders since it last
passed. The record is a table in docs/measurements/reliability.md; commit that page afterwards. A run with
``ARGS``, which may select a part, is not recorded.
"""

import os
import re
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parents[2]
RECORD = ROOT / "docs" / "measurements" / "reliability.md"
#: Lines of that page between which the table stands.
BEGIN, END = "<!-- long tests: written by `make long` -->", "<!-- end of long tests -->"
HEAD = "| long test | last passed | commit | minutes | amount |\n|---|---|---|---|---|\n"
#: The suite's tests that are marked `long`, in files beside one another as in `make test`.
MARKED = "python -m pytest -m long --numprocesses {JOBS} --dist loadfile"
#: All tests of a folder, marked or not.
WHOLE = "python -m pytest -m ''"


@dataclass(frozen=True)
class LongTest:
    """A test that `make test` leaves out.

    Attributes:
        does: what it does, in one line.
        folders: folders of the product that it tests; who changes one runs the test.
        steps: commands, run in the repository's root until one fails.
        amounts: variables in the commands, with their defaults; the environment overrides them.
    """

    does: str
    folders: tuple[str, ...]
    steps: tuple[str, ...]
    amounts: dict[str, str] = field(default_factory=dict)

    def amount(self) -> dict[str, str]:
        return {name: os.environ.get(name, default) for name, default in self.amounts.items()}

    def commands(self, more: str = "") -> list[list[str]]:
        """The commands with the variables filled in, the last with further arguments."""
        values = {"JOBS": os.environ.get("JOBS", "3"), **self.amount()}
        *first, last = (step.format(**values) for step in self.steps)
        return [shlex.split(step) for step in (*first, f"{last} {more}")]


TESTS = {
    "runs": LongTest(
        "train whole runs, kill them in every stage, change and repeat them",
        ("training", "shapespace/shell", "shapespace/solve", "shapespace/coordinates", "shapespace/bundle"),
        (f"{MARKED} tests/training",),
    ),
    "folders": LongTest(
        "train on some fifty small collections with one fault each; check the messages and the bundles",
        ("training", "shapespace/shell", "shapespace/solve", "shapespace/coordinates", "shapespace/model"),
        ("python -m tests.folders",),
    ),
    "people": LongTest(
        "make the bodies of the generators expressive and people with the package anny, and check how they move",
        ("training/collection/generators",),
        ("python -m pip install anny>=0.6.2,<0.7", f"{WHOLE} tests/long/test_people.py"),
    ),
    "faults": LongTest(
        "inflict every fault SEEDS times: kills, full disks, damaged files, slow clients and more",
        ("service", "training", "shapespace/bundle"),
        (f"env FAULT_SEEDS={{SEEDS}} {WHOLE} tests/faults",),
        {"SEEDS": "20"},
    ),
    "busy": LongTest(
        "run the whole suite RUNS times, each time beside at least four busy processes",
        ("tests",),
        ("python -m tests.long.busy {RUNS}",),
        {"RUNS": "5"},
    ),
    "server": LongTest(
        "the slow tests of running servers: floods, timeouts, crowds, attacks and proxies",
        ("service", "deploy", "Dockerfile"),
        (f"{MARKED} tests/service tests/test_wheel.py",),
    ),
    "soak": LongTest(
        "load the server with valid and invalid requests for MINUTES, under attack, and check every answer",
        ("service", "shapespace/model"),
        ("python -m tests.soak {MINUTES}",),
        {"MINUTES": "30"},
    ),
    "fuzz": LongTest(
        "try every parser with EXAMPLES generated and damaged files",
        ("shapespace/files", "shapespace/bundle"),
        (f"env FUZZ_EXAMPLES={{EXAMPLES}} {WHOLE} tests/fuzz/test_parsers.py",),
        {"EXAMPLES": "2000"},
    ),
    "costs": LongTest(
        "send EXAMPLES requests generated to be expensive; each has a budget of processor time and memory",
        ("service", "shapespace/files", "shapespace/model"),
        ("python -m tests.fuzz --examples {EXAMPLES} --limits",),
        {"EXAMPLES": "2000"},
    ),
    "fuzz-api": LongTest(
        "schemathesis on the whole HTTP interface, EXAMPLES requests for each call and phase",
        ("service/http", "openapi"),
        (f"env FUZZ_EXAMPLES={{EXAMPLES}} {WHOLE} tests/service/http/test_openapi.py -k schemathesis",),
        {"EXAMPLES": "100"},
    ),
    "mutants": LongTest(
        "make COUNT small mistakes in library and training and see which of them their tests miss",
        ("shapespace", "training"),
        ("python -m pip install cosmic-ray>=8.7 pytest-cov>=7", "python -m tests.mutants {COUNT}"),
        {"COUNT": "160"},
    ),
    "coverage": LongTest(
        "which lines of the library and of the service their tests run, in servers too; at least 90 %",
        ("shapespace", "service"),
        (
            "python -m pip install coverage>=7.10.3",
            "coverage run -m pytest -m '' tests/shapespace tests/service",
            "coverage combine --quiet",
            "coverage report --omit 'shapespace/service/*,shapespace/training/*' --fail-under 90",
            "coverage report --include 'shapespace/service/*' --fail-under 90",
        ),
    ),
    "quality": LongTest(
        "compare shapes of quality `auto` and `full` with exact shapes, at 1000 codes of each bundled model",
        ("shapespace/model", "shapespace/coordinates", "shapespace/bundle", "models"),
        (f"{MARKED} tests/service/calls/test_quality.py",),
    ),
    "page": LongTest("the slow tests of the page in Chromium", ("service/page",), (f"{MARKED} tests/page",)),
    "firefox": LongTest(
        "try the page in Firefox, by WebDriver BiDi (Debian: firefox-esr, xvfb, libegl1 and libgl1-mesa-dri)",
        ("service/page",),
        ("npm ci --prefix tests/firefox", "python -m tests.firefox"),
    ),
    "clients": LongTest(
        "have Blender and three.js open files of every bundled model (needs Python 3.11, downloads Blender)",
        ("shapespace/files",),
        ("python -m tests.clients .venv-blender/bin/python",),
    ),
    "image-test": LongTest(
        "build the container image, run it read-only in 2 GB and attack it (Docker, or root on Debian)",
        ("deploy", "Dockerfile"),
        ("scripts/image-test.sh",),
    ),
}


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


def recorded() -> dict[str, str]:
    """Rows of the page's table, by the name of the test."""
    table = RECORD.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0]
    return {match[1]: match[0] for match in re.finditer(r"^\| `([\w-]+)` \|.*$", table, re.MULTILINE)}


def record(name: str, minutes: float) -> None:
    """Write the row of a test that has just passed."""
    amount = ", ".join(f"`{key}={value}`" for key, value in TESTS[name].amount().items())
    changed = " with changes" if git("status", "--porcelain", "--", ".", f":!{RECORD.relative_to(ROOT)}") else ""
    commit = f"`{git('rev-parse', '--short', 'HEAD')}`{changed}"
    row = f"| `{name}` | {datetime.now(UTC):%Y-%m-%d} | {commit} | {minutes:.0f} | {amount} |"
    rows = recorded() | {name: row}
    before, _, rest = RECORD.read_text(encoding="utf-8").partition(BEGIN)
    table = HEAD + "\n".join(rows[each] for each in TESTS if each in rows)
    RECORD.write_text(f"{before}{BEGIN}\n{table}\n{END}{rest.partition(END)[2]}", encoding="utf-8")


def listing() -> str:
    """All tests, with the commits that have changed their folders since they last passed."""
    lines, rows = ["make long NAME …, where NAME is one of"], recorded()
    for name, test in TESTS.items():
        amounts = "".join(f" {key}={value}" for key, value in test.amounts.items())
        commit = re.search(r"`([0-9a-f]{7,40})`", rows.get(name, ""))
        since = git("rev-list", "--count", f"{commit[1]}..HEAD", "--", *test.folders) if commit else ""
        passed = f"{since} commits to these folders since it last passed" if since else "no recorded pass"
        lines += [f"  {name + amounts:22} {test.does}", f"  {'':22} {', '.join(test.folders)}: {passed}"]
    return "\n".join(lines)


def run(name: str) -> bool:
    """Run a test, record it if it passes, and return whether it did."""
    more = os.environ.get("ARGS", "")
    began = time.monotonic()
    for command in TESTS[name].commands(more):
        print("+", shlex.join(command), flush=True)
        if subprocess.run(command, cwd=ROOT, check=False).returncode:
            return False
    if more:
        print("Not recorded, because ARGS may have selected a part of the test.")
    else:
        record(name, (time.monotonic() - began) / 60)
    return True


def main() -> int:
    names = sys.argv[1:]
    unknown = [name for name in names if name not in TESTS]
    if unknown or not names:
        print(*(f"There is no long test {name!r}." for name in unknown), listing(), sep="\n")
        return 2 if unknown else 0
    failed = [name for name in names if not run(name)]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
