"""The programs: help, version, arguments that nobody knows, and installations without the packages they need."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from shapespace import __version__
from shapespace.service.__main__ import NEEDED as FOR_SERVING
from shapespace.training.__main__ import NEEDED as FOR_TRAINING
from shapespace.training.__main__ import main
from shapespace.training.stages import STAGE_NAMES
from shapespace.training.stages.run import STAGES

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
TRAIN, SERVE = "shapespace.training", "shapespace.service"
SUBCOMMANDS = ("init", "run", "status", "report", "export")
#: Runs a module where some packages can't be found, whichever way it looks for them.
HIDING = """
import runpy, sys
hidden = sys.argv[1].split(",")
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Hide())
sys.argv = sys.argv[2:]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, timeout=120, stdin=subprocess.DEVNULL
    )


def trained(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[object, str]:
    """Exit code and output of ``shapespace-train`` in this process."""
    monkeypatch.setattr(sys, "argv", ["shapespace-train", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    captured = capsys.readouterr()
    return end.value.code, captured.out + captured.err


@pytest.mark.parametrize("command", [(), *((name,) for name in SUBCOMMANDS)])
def test_every_command_of_training_has_help_and_a_version_and_knows_its_arguments(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program = " ".join(("shapespace-train", *command))
    code, words = trained(monkeypatch, capsys, *command, "--help")
    assert code == 0
    assert words.startswith(f"usage: {program} ")
    assert trained(monkeypatch, capsys, *command, "--version") == (0, f"shapespace {__version__}\n")
    for unknown in ("--port", "--vers"):
        given = [*command, "folder", unknown] if command else [unknown]
        code, words = trained(monkeypatch, capsys, *given)
        assert code == 2
        assert "error" in words


def test_the_server_has_help_and_a_version_and_points_from_arguments_to_settings() -> None:
    assert call("-m", SERVE, "--version").stdout == f"shapespace {__version__}\n"
    done = call("-m", SERVE, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "SHAPESPACE_PORT" in done.stdout
    for arguments in (("--port", "1"), ("models",), ("--po",)):
        done = call("-m", SERVE, *arguments)
        assert (done.returncode, done.stdout) == (2, "")
        assert f"unrecognized arguments: {' '.join(arguments)}" in done.stderr
        assert "SHAPESPACE_PORT=" in done.stderr


@pytest.mark.parametrize(
    ("module", "extra", "hidden", "arguments"),
    [
        (TRAIN, "train", "torch,matplotlib,tomlkit,tqdm,PIL,jinja2,safetensors,onnxscript", ("status", "runs/none")),
        (SERVE, "serve", "fastapi,uvicorn,pydantic_settings,starlette,orjson", ()),
    ],
)
def test_without_its_packages_a_program_helps_and_says_what_to_install(
    module: str, extra: str, hidden: str, arguments: tuple[str, ...]
) -> None:
    done = call("-c", HIDING, hidden, module, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage:" in done.stdout
    done = call("-c", HIDING, hidden, module, *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    (sentence,) = done.stderr.splitlines()
    assert f"pip install 'shapespace[{extra}]'" in sentence
    assert all(name in sentence for name in hidden.split(","))


@pytest.mark.parametrize(("extra", "needed"), [("train", FOR_TRAINING), ("serve-without-mkl", FOR_SERVING)])
def test_what_programs_look_for_is_what_the_extra_installs(extra: str, needed: tuple[str, ...]) -> None:
    modules = {"pillow": "PIL", "python-json-logger": "pythonjsonlogger"}
    optional = {"embreex", "pypardiso"}
    names = {re.split(r"[\[><=;]", line)[0] for line in PROJECT["optional-dependencies"][extra]} - optional
    assert sorted(needed, key=str.lower) == sorted(
        (modules.get(name, name.replace("-", "_")) for name in names), key=str.lower
    )


def test_the_help_names_the_stages_that_there_are() -> None:
    assert tuple(STAGES) == STAGE_NAMES == tuple(stage.name for stage in STAGES.values())
