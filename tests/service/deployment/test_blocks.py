"""Every block of code in the documentation works; the list of settings is complete.

Calls and Python run unchanged, with a real server. Commands that need minutes or other machines are only checked
against the Makefile, the command line's parser, or a program's own help.
"""

import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import click
import httpx
import numpy as np
import pytest

from shapespace.__main__ import PROGRAM
from shapespace.command_line import Subcommand
from shapespace.files.formats import MESH_FORMATS
from shapespace.files.reading import read_arrays
from shapespace.model.shape_model import load
from shapespace.page_scripts import PAGE
from shapespace.service.settings import PREFIX, Settings
from shapespace.training.runs.config import parse
from tests.long.__main__ import TESTS
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, starting
from tests.service.watching import eventually
from tests.test_docs import NAMES, PAGES, text_of

MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")

#: Blocks that are not tested, by page and first line, and why.
UNTRIED = {
    (
        "docs/how-to/serve.md",
        "docker build -t shapespace . && docker run --rm --read-only -p 127.0.0.1:8000:8000 shapespace",
    ): ("needs a container engine; `make long image-test` builds and tries the same"),
    ("docs/how-to/collections.md", "pip install '.[people]'"): (
        "installs 500 MB and trains for more than an hour; `make long people` makes the same bodies"
    ),
    ("docs/how-to/gpu.md", ".venv/bin/pip install --force-reinstall torch==2.13.0 --index-url INDEX"): (
        "needs a GPU and an index of PyTorch"
    ),
    ("docs/how-to/call.md", "using System;"): "needs .NET or Mono; the block above it sends the same request",
}


@dataclass(frozen=True)
class Block:
    page: str
    language: str
    text: str

    @property
    def place(self) -> tuple[str, str]:
        return self.page, self.text.split("\n")[0]

    def __str__(self) -> str:
        return f"{self.page}: {self.text.split(chr(10))[0][:60]}"


BLOCKS = [
    Block(name, language, text)
    for page, name in zip(PAGES, NAMES, strict=True)
    for language, text in re.findall(
        r"^ *```(.*?)\n(.*?)^ *```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
]


def run(command: list[str], server: Server, folder: Path) -> None:
    (folder / ".curlrc").write_text("fail-with-body\nsilent\nshow-error\n")
    environment = os.environ | {"CURL_HOME": str(folder), "PYTHONPATH": str(ROOT)}
    command[-1] = command[-1].replace("localhost:8000", server.url.removeprefix("http://"))
    found = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=600
    )
    assert found.returncode == 0, found.stdout + found.stderr


def try_command(line: str) -> None:
    """Check a command without running it: its targets, options and variables exist."""
    program, *words = shlex.split(line)
    while program.startswith(PREFIX):  # environment variables before the command
        assert program.partition("=")[0].removeprefix(PREFIX).lower() in Settings.model_fields, program
        program, *words = words
    match Path(program).name:
        case "make" if words[0] == "long":
            assert set(words[1:]) <= {*TESTS, "NAME"}, words
        case "make":
            for word in words:
                variable, is_variable, _ = word.partition("=")
                known = rf"\$\([^)]*\b{variable}\b" if is_variable else rf"^{word}:.*##"
                assert re.search(known, MAKEFILE, re.MULTILINE), f"the Makefile has no {word}"
        case "shapespace" | "shapespace-train":
            command = PROGRAM.commands[words[0]]
            assert isinstance(command, Subcommand)
            with suppress(click.exceptions.Exit):  # of --help
                command.make_context(words[0], words[1:] or ["--help"])
        case "source":
            assert words == [".venv/bin/activate"]  # as the Makefile makes it
        case "npm":
            assert words == ["install", "onnxruntime-web"]  # try_javascript has its runtime
        case "python" if words[0] == "-m":
            assert importlib.util.find_spec(words[1]), words[1]
        case "python" if words[0] == "-c":
            compile(words[1], line, "exec")
        case "dask":
            dask = Path(sys.executable).with_name("dask")
            told = subprocess.run([dask, words[0], "--help"], capture_output=True, text=True, check=True).stdout
            assert {word for word in words if word.startswith("--")} <= set(re.findall(r"--[\w-]+", told))
        case other:
            pytest.fail(f"add a case here that checks {other}, or list the block in UNTRIED")


def try_shell(text: str, server: Server, folder: Path) -> None:
    if "curl " in text:
        run(["bash", "-euo", "pipefail", "-c", text], server, folder)
        for file in re.findall(r"-o (\S+\.glb)", text):
            assert (folder / file).read_bytes()[:4] == b"glTF"
    else:
        for line in text.splitlines():
            try_command(line.partition("#")[0])


def try_configuration(text: str, server: Server, folder: Path) -> None:
    """The only TOML on the pages is a configuration of a run."""
    assert parse(text, "the page").collection.data


def try_python(text: str, server: Server, folder: Path) -> None:
    (folder / "models").symlink_to(ROOT / "models")
    run([sys.executable, "-c", text], server, folder)


def try_javascript(text: str, server: Server, folder: Path) -> None:
    if runs_decoder := "onnxruntime-web" in text:
        (folder / "models").symlink_to(ROOT / "models")
        package = folder / "node_modules" / "onnxruntime-web"
        package.mkdir(parents=True)
        (package / "package.json").write_text('{"type": "module", "exports": "./index.js"}')
        vendored = PAGE / "vendor" / "onnxruntime"
        packed = vendored / "ort-wasm-simd-threaded.wasm.gz"
        (package / "index.js").write_text(
            f"""import {{ readFileSync }} from "node:fs";
            import {{ gunzipSync }} from "node:zlib";
            import {{ env }} from {str(vendored / "ort.wasm.min.mjs")!r};
            Object.assign(env.wasm, {{ numThreads: 1, wasmBinary: gunzipSync(readFileSync({str(packed)!r})) }});
            export * from {str(vendored / "ort.wasm.min.mjs")!r};"""
        )
        model = load("figure")
        (folder / "reference.obj").write_bytes(MESH_FORMATS["obj"].encode(model.vertices, model.faces, None, None))
    run(["node", "--input-type=module", "--eval", text], server, folder)
    if runs_decoder:
        found, faces = read_arrays((folder / "shape.obj").read_bytes(), "obj")[:2]
        expected = model.shape(np.array([0.5] + 19 * [0]), quality="draft").vertices
        assert np.array_equal(faces, model.faces)
        assert np.abs(found - expected).max() < 2e-5 * np.linalg.norm(np.ptp(expected, axis=0))


def try_log_line(text: str, server: Server, folder: Path) -> None:
    """The only JSON on the pages is a log line for a request, as with SHAPESPACE_LOG_FORMAT=json."""
    shown = json.loads(text)
    (folder / "models").mkdir()
    with starting() as start:
        asked = start(folder / "models", log_format="json")
        httpx.request(shown["method"], asked.url + shown["path"])
        lines = [json.loads(line) for line in asked.stop().splitlines()]
    written = next(line for line in lines if line.get("path") == shown["path"])
    assert {key: type(value) for key, value in shown.items()} == {key: type(value) for key, value in written.items()}
    assert (shown["logger"], shown["route"]) == (written["logger"], written["route"])


def try_map(text: str, server: Server, folder: Path) -> None:
    """A block without a language lists paths of the repository, one a line."""
    for line in text.splitlines():
        assert (ROOT / line.split()[0]).exists(), line


def try_drawing(text: str, server: Server, folder: Path) -> None:
    """The drawing of the packages has all of them, and no others."""
    tops = [ROOT / name for name in ("shapespace", "service", "training")]
    drawn = set(re.findall(r"│ ([a-z_]+) {2,}", text))
    rooms = {init.parent.name for top in tops for init in top.glob("*/__init__.py")} - {"service", "training"}
    assert rooms <= drawn
    assert not [name for name in drawn if not any(list(top.glob(f"{name}*")) for top in tops)]


TRIALS: dict[str, Callable[[str, Server, Path], None]] = {
    "sh": try_shell,
    "toml": try_configuration,
    "python": try_python,
    "js": try_javascript,
    "json": try_log_line,
    "": try_map,
    "text": try_drawing,
    "console": lambda text, server, folder: None,  # what a program prints
}


#: Blocks that change a folder of models, each after the one before.
ROLLOUT = [block for block in BLOCKS if "models/default-versions" in block.text]


def test_a_new_version_is_rolled_out_and_back_as_the_page_says(tmp_path: Path) -> None:
    write_bundle(tmp_path / "models", "figure", "3")
    write_bundle(tmp_path / "new", "figure", "4").rename(tmp_path / "new" / "4")
    codes = [f"0.1,0.7,{k / 100}" for k in range(120)]
    answered = []
    with starting() as start:
        server = start(tmp_path / "models", watch=0.1)
        with httpx.Client(base_url=server.url, timeout=60) as client:
            for line in "".join(block.text for block in ROLLOUT).splitlines():
                if "grep" in line and "requests" in line:
                    eventually(lambda: 'version="4"} 0.05' in client.get("/metrics").text, seconds=60)
                    found = [client.get("/v1/models/figure/mesh", params={"latent": code}) for code in codes]
                    answered += [Counter(answer.headers["Model-Version"] for answer in found)]

                def works(line: str = line) -> bool:
                    try:
                        run(["bash", "-euo", "pipefail", "-c", line], server, tmp_path)
                    except AssertionError:  # the server has not reloaded yet
                        return False
                    return True

                eventually(works, seconds=60)
    assert (tmp_path / "new.glb").read_bytes()[:4] == b"glTF"
    assert answered[0]["3"] > 100
    assert 1 <= answered[0]["4"] <= 19


def in_order(blocks: list[Block]) -> list[Block]:
    """Join the calls of a page, and its Python: readers type one block after the other."""
    joined: dict[object, Block] = {}
    for block in blocks:
        together = block.language == "python" or (block.language == "sh" and "curl " in block.text)
        key = (block.page, block.language) if together else block
        before = joined[key].text if key in joined else ""
        joined[key] = Block(block.page, block.language, before + block.text)
    return list(joined.values())


TRIED = in_order([block for block in BLOCKS if block.place not in UNTRIED and block not in ROLLOUT])


@pytest.mark.parametrize("block", TRIED, ids=str)
def test_blocks_do_what_they_say(server: Server, tmp_path: Path, block: Block) -> None:
    assert block.language in TRIALS, "add a trial for its language, or list it in UNTRIED"
    TRIALS[block.language](block.text, server, tmp_path)


def test_no_block_is_overlooked() -> None:
    assert set(UNTRIED) <= {block.place for block in BLOCKS}
    fences = sum(page.read_text(encoding="utf-8").count("```") for page in PAGES)
    assert fences == 2 * len(BLOCKS) >= 24


COMMANDS = sorted(
    {
        command.replace("\n", " ")
        for page in PAGES
        if page.name != "CHANGELOG.md"  # which also names commands that are gone
        for command in re.findall(r"`((?:make|shapespace|shapespace-train|python -m|dask) [^`]+)`", text_of(page))
    }
)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_within_the_text_exist(command: str) -> None:
    try_command(command)


def test_options_within_the_text_exist() -> None:
    for page in PAGES:
        for variable in re.findall(r"`([A-Z]+)=[^`]*`", text_of(page)):
            in_makefile = f"$({variable})" in MAKEFILE or f"$(or $({variable})" in MAKEFILE
            assert in_makefile or any(variable in test.amounts for test in TESTS.values()), variable


def test_every_setting_is_listed_and_none_else() -> None:
    listed = set(
        re.findall(rf"`({PREFIX}[A-Z_]+)`", (ROOT / "docs" / "reference" / "settings.md").read_text(encoding="utf-8"))
    )
    assert listed == {(PREFIX + name).upper() for name in Settings.model_fields}
