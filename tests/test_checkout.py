"""A checkout without symbolic links, as git makes it on Windows by default, says so."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The files that are needed, with a text file in the place of one link."""
    (tmp_path / "shapespace").mkdir()
    for name in ("Makefile", "setup.py", "shapespace/__init__.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "shapespace" / "service").write_text("../service")
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [("make", "help"), (sys.executable, "-c", "import shapespace"), (sys.executable, "setup.py", "--version")],
    ids=["make", "import", "setup"],
)
def test_a_checkout_without_links_says_what_to_do(checkout: Path, command: tuple[str, ...]) -> None:
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "shapespace/service is a text file where a link to ../service should be" in done.stderr
    assert "git config core.symlinks true" in done.stderr
