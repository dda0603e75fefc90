"""Mutation testing of library and training: ``python -m tests.mutants [COUNT] [--seed N] [--only T]``.

Cosmic Ray makes mutants, each a copy of the code with one small change. Of all possible mutants a random
sample is tested, with a share for each module by its number of lines, and no two at one position. A mutant
is run with the tests that cover its line, those of its own module first. The diffs of surviving mutants are
in build/mutants.diff.
"""

import argparse
import ast
import os
import random
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_db import WorkDB
from cosmic_ray.work_item import MutationSpec, TestOutcome
from coverage import CoverageData

ROOT = Path(__file__).parents[2]
PYTEST = [sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "-p", "no:cacheprovider"]
#: What is changed, and tested by the tests of the same name.
PACKAGES = ("shapespace", "training")
#: What the tests need beside them.
COPIED = (*PACKAGES, "service", "models", "tests", "benchmarks", "runs", "examples", "docs", "scripts")
#: Time limit for a mutant, as a multiple of the time of all tests on the unchanged code.
PATIENCE = 1.5

#: Changes that tests might miss. Left out are those that every test detects (a sum that becomes a shift),
#: near duplicates (seven ways to change a comparison), and `|`, which is mostly in annotations.
OPERATORS = {
    *(f"ReplaceBinaryOperator_{pair}" for pair in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul", "Mod_Mul")),
    *(f"ReplaceBinaryOperator_{pair}" for pair in ("FloorDiv_Mul", "BitAnd_BitOr")),
    *(f"ReplaceComparisonOperator_{pair}" for pair in ("Lt_LtE", "Lt_GtE", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_LtE")),
    *(f"ReplaceComparisonOperator_{pair}" for pair in ("GtE_Gt", "GtE_Lt", "Eq_NotEq", "NotEq_Eq")),
    *("ReplaceComparisonOperator_Is_IsNot", "ReplaceComparisonOperator_IsNot_Is"),
    *(f"ReplaceUnaryOperator_{change}" for change in ("USub_UAdd", "Delete_Not", "Delete_Invert")),
    *("ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd"),
    *("ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ZeroIterationForLoop"),
    *("AddNot", "ExceptionReplacer", "NumberReplacer", "RemoveDecorator"),
}


def name_of(mutation: MutationSpec) -> str:
    line, column = mutation.start_pos
    operator = mutation.operator_name.removeprefix("core/")
    return f"{mutation.module_path.stem}:{line}:{column} {operator} {mutation.occurrence}"


def sample(modules: list[Path], count: int, seed: int) -> tuple[int, list[MutationSpec]]:
    """The number of possible mutants, and a sample in random order, whose beginnings are samples too."""
    possible: dict[Path, list[MutationSpec]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        database = WorkDB(Path(folder) / "all.sqlite", WorkDB.Mode.create)
        init(modules, database, {})
        for item in database.work_items:
            mutation = item.mutations[0]
            if mutation.operator_name.removeprefix("core/") in OPERATORS:
                possible[mutation.module_path].append(mutation)
        database.close()
    lines = {module: len(module.read_text(encoding="utf-8").splitlines()) for module in sorted(possible)}
    rng = random.Random(seed)
    chosen = []
    for module, length in lines.items():
        places = defaultdict(list)
        for mutation in sorted(possible[module], key=lambda m: (m.start_pos, m.operator_name, m.occurrence)):
            places[mutation.start_pos].append(mutation)
        share = max(1, round(count * length / sum(lines.values())))
        chosen += [rng.choice(places[at]) for at in rng.sample(list(places), min(share, len(places)))]
    rng.shuffle(chosen)
    return sum(map(len, possible.values())), chosen


class Tests:
    """Which tests run a line, from the coverage data of a run of all tests."""

    def __init__(self) -> None:
        data = CoverageData("build/coverage")
        data.read()
        self._contexts = {Path(file).resolve(): data.contexts_by_lineno(file) for file in data.measured_files()}

    def of(self, mutation: MutationSpec) -> list[str]:
        module = mutation.module_path
        by_line = self._contexts.get(module.resolve(), {})
        lines = statements(module).get(mutation.start_pos[0], ())
        found = functions(by_line.get(line, []) for line in lines)
        # A line that runs on import may be detected by every test of the module.
        if not lines or any("" in by_line.get(line, []) for line in lines):
            found = functions(by_line.values())
        own = f"tests/{module.parent}/test_{module.stem}.py"
        return sorted(found, key=lambda test: (not test.startswith(own), test))


def functions(contexts: Iterable[list[str]]) -> set[str]:
    """Test functions, whatever their parameters, of contexts like ``test_x.py::test_y[z]|run``."""
    return {name.partition("|")[0].partition("[")[0] for names in contexts for name in names if name}


def statements(module: Path) -> dict[int, range]:
    """For each line number, the lines of the innermost statement at it, without the statement's body."""
    found = {}
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):  # outer statements come first
        if isinstance(node, ast.stmt):
            end = node.body[0].lineno if hasattr(node, "body") else node.end_lineno + 1
            found |= dict.fromkeys(range(node.lineno, end), range(node.lineno, end))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutants", description="Mutation testing of library and training."
    )
    parser.add_argument("count", nargs="?", type=int, default=160, help="how many mutants")
    parser.add_argument("--seed", type=int, default=9)
    parser.add_argument("--only", default="", metavar="TEXT", help="of the sample, those with this in their names")
    options = parser.parse_args()
    report = ROOT / "build" / "mutants.diff"
    report.parent.mkdir(exist_ok=True)
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as copy:
        unneeded = shutil.ignore_patterns("node_modules", "__pycache__")
        for package in COPIED:
            shutil.copytree(ROOT / package, Path(copy) / package, ignore=unneeded, symlinks=True)
        shutil.copy(ROOT / "pyproject.toml", copy)
        (Path(copy) / "build").mkdir()
        os.chdir(copy)
        os.environ["PYTHONPATH"] = copy
        start = time.monotonic()
        measured = ["--cov=shapespace", "--cov-context=test", "--cov-report="]  # a link there leads to training
        subprocess.run([*PYTEST, *measured, *(f"tests/{package}" for package in PACKAGES)], check=True)
        timeout = PATIENCE * (time.monotonic() - start)
        modules = [
            path
            for package in PACKAGES
            for path in Path(package).glob("[a-z]*/**/[a-z]*.py")
            if not any(parent.is_symlink() for parent in path.parents)
        ]
        total, chosen = sample(sorted(modules), options.count, options.seed)
        print(f"{len(chosen)} of {total} mutants, seed {options.seed}, at most {timeout:.0f} s each", flush=True)
        tests = Tests()
        with report.open("w", encoding="utf-8") as survivors:
            for mutation in chosen:
                name = name_of(mutation)
                if options.only not in name:
                    continue
                command = shlex.join([*PYTEST, *tests.of(mutation)]) if tests.of(mutation) else "true"  # survives
                result = mutate_and_test([mutation], command, timeout)
                outcome = "timed out" if result.output == "timeout" else str(result.test_outcome.value)
                outcomes[outcome] += 1
                print(f"{outcome:9} {name}", flush=True)
                if result.test_outcome is not TestOutcome.KILLED:
                    print(name, result.diff or result.output, sep="\n", file=survivors, flush=True)
    print(", ".join(f"{number} {outcome}" for outcome, number in sorted(outcomes.items())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
