"""The programs: help, version, arguments that nobody knows, and installations without the packages they need."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import pytest

from shapespace import __version__
from shapespace.__main__ import PROGRAM
from shapespace.__main__ import main as every_command
from shapespace.commands import NEEDED as FOR_MODELS
from shapespace.service.__main__ import NEEDED as FOR_SERVING
from shapespace.training.__main__ import NEEDED as FOR_TRAINING
from shapespace.training.__main__ import main
from shapespace.training.stages import STAGE_NAMES
from shapespace.training.stages.run import STAGES

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
TRAIN, SERVE, EVERY = "shapespace.training", "shapespace.service", "shapespace"
PROGRAMS = {"shapespace-train": main, "shapespace": every_command}
SUBCOMMANDS = ("init", "run", "status", "report", "export")
ALL = ("decode", "encode", "fit", "models", "page", "serve", *SUBCOMMANDS)
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
#: Runs a module that Ctrl-C stops when it imports one of some packages.
STOPPING = HIDING.replace('raise ModuleNotFoundError(f"No module named {name!r}", name=name)', "signal.raise_signal(2)")
STOPPING = f"import signal{STOPPING}"


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, timeout=120, stdin=subprocess.DEVNULL
    )


def ended(
    program: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[object, str]:
    """Exit code and output of a program in this process, which ends before it does any work."""
    monkeypatch.setattr(sys, "argv", [program, *arguments])
    with pytest.raises(SystemExit) as end:
        PROGRAMS[program]()
    captured = capsys.readouterr()
    return end.value.code, captured.out + captured.err


@pytest.mark.parametrize(
    ("program", "command"),
    [
        *((program, ()) for program in PROGRAMS),
        *(("shapespace-train", (name,)) for name in SUBCOMMANDS),
        *(("shapespace", (name,)) for name in ALL),
    ],
)
def test_every_command_has_help_and_a_version_and_knows_its_arguments(
    program: str, command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def end(*arguments: str) -> tuple[object, str]:
        return ended(program, monkeypatch, capsys, *command, *arguments)

    whole = " ".join((program, *command))
    code, words = end("--help")
    assert code == 0
    assert words.startswith(f"usage: {whole} ")
    assert not command or f"Examples:\n  {whole}" in words
    assert end("-h") == (code, words)
    assert end("--version") == (0, f"shapespace {__version__}\n")
    for unknown in ("--port", "--vers"):
        code, words = end(*(["folder"] if command else []), unknown)
        assert code == 2
        assert f"{whole}: error: " in words
        assert unknown in words


def test_the_program_has_every_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert sorted(PROGRAM.commands) == sorted(ALL)
    _, words = ended("shapespace", monkeypatch, capsys, "--help")
    assert re.findall(r"^  ([a-z]+)  ", words, re.MULTILINE) == [*PROGRAM.commands]


def test_the_shell_completes_commands_options_and_models(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("_SHAPESPACE_COMPLETE", "bash_source")
    assert "complete -o nosort -F" in ended("shapespace", monkeypatch, capsys)[1]
    monkeypatch.setenv("_SHAPESPACE_COMPLETE", "bash_complete")
    for typed, offered in (
        ("shapespace de", ["decode"]),
        ("shapespace decode f", ["figure", "freaky-torus"]),
        ("shapespace fit figure scan.ply --land", ["--landmarks"]),
        ("shapespace run --until m", ["mean", "modes"]),
    ):
        monkeypatch.setenv("COMP_WORDS", typed)
        monkeypatch.setenv("COMP_CWORD", str(typed.count(" ")))
        words = ended("shapespace", monkeypatch, capsys)[1]
        assert [line.partition(",")[2] for line in words.splitlines()] == offered


def test_help_imports_nothing_heavy() -> None:
    program = """
import sys
from shapespace.__main__ import main
sys.argv = ["shapespace", *sys.argv[1:]]
try:
    main()
finally:
    print([name for name in ("fastapi", "numpy", "onnx", "onnxruntime", "pydantic", "torch") if name in sys.modules])
"""
    for arguments in (("--help",), ("run", "--help"), ("decod",)):
        assert call("-c", program, *arguments).stdout.splitlines()[-1] == "[]"
    assert call("-c", program, "models").stdout.splitlines()[-1] == "['numpy', 'onnx', 'pydantic']"


@pytest.mark.parametrize("words", [["--accept", "a", "b", "--until", "mean"], ["--accept", "a", "--accept", "b"]])
def test_an_option_may_have_several_values(words: list[str]) -> None:
    command = PROGRAM.commands["run"]
    assert command.make_context("run", ["c.toml", *words]).params["accept"] == ("a", "b")
    with pytest.raises(click.UsageError, match="unexpected extra argument"):
        command.make_context("run", ["c.toml", "--models", "m", "b"])


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
        (EVERY, "model", "onnx,onnxruntime,pydantic", ("fit", "figure", "scan.ply", "--partial")),
    ],
)
def test_without_its_packages_a_program_helps_and_says_what_to_install(
    module: str, extra: str, hidden: str, arguments: tuple[str, ...]
) -> None:
    done = call("-c", HIDING, hidden, module, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage:" in done.stdout
    if module == EVERY:
        done = call("-c", HIDING, hidden, module, arguments[0], "--help")
        assert (done.returncode, done.stderr) == (0, "")
        assert f"pip install 'shapespace[{extra}]'" in " ".join(done.stdout.split())
    done = call("-c", HIDING, hidden, module, *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    (sentence,) = done.stderr.splitlines()
    assert f"pip install 'shapespace[{extra}]'" in sentence
    assert all(name in sentence for name in hidden.split(","))


@pytest.mark.parametrize(
    ("extra", "needed"), [("train", FOR_TRAINING), ("serve-without-mkl", FOR_SERVING), ("model", FOR_MODELS)]
)
def test_what_programs_look_for_is_what_the_extra_installs(extra: str, needed: tuple[str, ...]) -> None:
    modules = {"pillow": "PIL", "python-json-logger": "pythonjsonlogger"}
    optional = {"embreex", "pypardiso"}
    names = {re.split(r"[\[><=;]", line)[0] for line in PROJECT["optional-dependencies"][extra]} - optional
    assert sorted(needed, key=str.lower) == sorted(
        (modules.get(name, name.replace("-", "_")) for name in names), key=str.lower
    )


def test_the_help_names_the_stages_that_there_are() -> None:
    assert tuple(STAGES) == STAGE_NAMES == tuple(stage.name for stage in STAGES.values())


@pytest.mark.parametrize(
    ("package", "arguments"),
    [
        ("scipy", (EVERY, "decode", "figure", "--out", "-")),
        ("uvicorn", (SERVE,)),
        ("safetensors", (TRAIN, "status", "none")),
    ],
)
def test_ctrl_c_while_packages_are_imported_ends_with_a_word(package: str, arguments: tuple[str, ...]) -> None:
    done = call("-c", STOPPING, package, *arguments)
    assert (done.returncode, done.stdout, done.stderr.strip().endswith(": stopped")) == (130, "", True)
    assert "Traceback" not in done.stderr
