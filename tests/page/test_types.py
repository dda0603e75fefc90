"""The page's scripts agree with the types in their comments, and are formatted by prettier."""

import subprocess

from tests.service.conftest import ROOT

#: Characters in a line.
WIDTH = 110


def test_the_scripts_have_the_form_that_prettier_gives_them() -> None:
    formatter = ROOT / "tests" / "node_modules" / "prettier" / "bin" / "prettier.cjs"
    scripts = [*(ROOT / "service" / "page" / "js").rglob("*.js"), *(ROOT / "tests").glob("[cf]*/*.mjs")]
    command = ["node", str(formatter), "--print-width", str(WIDTH), "--check", *map(str, scripts)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, f"{found.stderr}\nprettier --print-width {WIDTH} --write formats them"
    lines = [
        (path.name, k)
        for path in scripts
        for k, line in enumerate(path.read_text().splitlines(), 1)
        if len(line) > WIDTH
    ]
    assert lines == [], "prettier does not wrap comments and strings"


def test_the_scripts_are_sound_by_their_types() -> None:
    compiler = ROOT / "tests" / "node_modules" / "typescript" / "bin" / "tsc"
    command = ["node", str(compiler), "--project", str(ROOT / "tests" / "page")]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.stdout == ""
    assert found.returncode == 0
