"""The README's recipes, run as they stand there against a real server; its list of settings is whole."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from service.settings import PREFIX, Settings
from tests.service.conftest import ROOT, Server

README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(sh|python)\n(.*?)```", README, re.DOTALL)
SHELL = [text for language, text in BLOCKS if language == "sh" and "curl " in text]
PYTHON = [text for language, text in BLOCKS if language == "python"]


def run(command: list[str], server: Server, folder: Path) -> None:
    (folder / ".curlrc").write_text("fail-with-body\nsilent\nshow-error\n")
    environment = os.environ | {"CURL_HOME": str(folder), "PYTHONPATH": str(ROOT)}
    found = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr


@pytest.mark.parametrize("text", SHELL, ids=[text.split("\n")[0][:60] for text in SHELL])
def test_shell_recipes_work(server: Server, tmp_path: Path, text: str) -> None:
    here = text.replace("localhost:8000", server.url.removeprefix("http://"))
    run(["bash", "-euo", "pipefail", "-c", here], server, tmp_path)
    for file in re.findall(r"-o (\S+\.glb)", text):
        assert (tmp_path / file).read_bytes()[:4] == b"glTF"


@pytest.mark.parametrize("text", PYTHON, ids=[text.split("\n")[0][:60] for text in PYTHON])
def test_python_recipes_work(server: Server, tmp_path: Path, text: str) -> None:
    run([sys.executable, "-c", text.replace("localhost:8000", server.url.removeprefix("http://"))], server, tmp_path)


def test_there_are_recipes() -> None:
    assert len(SHELL) >= 3
    assert len(PYTHON) >= 2


def test_every_setting_is_listed_and_none_else() -> None:
    listed = set(re.findall(rf"`({PREFIX}[A-Z_]+)`", README))
    assert listed == {(PREFIX + name).upper() for name in Settings.model_fields}
