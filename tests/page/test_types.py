"""The page's scripts keep to the types that their comments state."""

from __future__ import annotations

import subprocess

from tests.service.conftest import ROOT


def test_the_scripts_are_sound_by_their_types() -> None:
    compiler = ROOT / "tests" / "node_modules" / "typescript" / "bin" / "tsc"
    command = ["node", str(compiler), "--project", str(ROOT / "tests" / "page")]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.stdout == ""
    assert found.returncode == 0
