"""The commands that use a model without a server: files in, files out, and messages."""

import csv
import io
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from shapespace.__main__ import main
from shapespace.files.formats import MESH_FORMATS
from shapespace.files.reading import read_arrays
from shapespace.model.shape_model import ShapeModel, load
from tests.service.bundles import write_bundle

CODE = "0.1,0.7,0.4"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("commands")
    write_bundle(place / "models", "small", fine=True)
    (place / "plain").write_text("kept")
    return place


@pytest.fixture(scope="module")
def model(folder: Path) -> ShapeModel:
    return load(folder / "models" / "small")


class Shell:
    """Runs ``shapespace`` in this process; keeps what the last command has written.

    Attributes:
        out, err: standard output and standard error.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
        self._monkeypatch, self._capture, self.out, self.err = monkeypatch, capfdbinary, b"", ""

    def __call__(self, *arguments: str | Path, code: int = 0) -> str:
        self._monkeypatch.setattr(sys, "argv", ["shapespace", *map(str, arguments)])
        try:
            found = main()
        except SystemExit as end:
            found = int(end.code or 0)
        sys.stdout.flush()
        captured = self._capture.readouterr()
        self.out, self.err = captured.out, captured.err.decode()
        assert found == code, self.err
        assert "Traceback" not in self.err
        return self.out.decode(errors="replace")


@pytest.fixture
def shell(folder: Path, monkeypatch: pytest.MonkeyPatch, capfdbinary: pytest.CaptureFixture[bytes]) -> Iterator[Shell]:
    monkeypatch.chdir(folder)
    before = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    yield Shell(monkeypatch, capfdbinary)
    for number, handler in before:
        signal.signal(number, handler)


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_the_list_has_models_here_and_installed_models(shell: Shell) -> None:
    rows = [line.split() for line in shell("models").splitlines()]
    assert rows[0] == ["name", "version", "numbers", "licence", "title"]
    assert ["small", "1", "3", "CC0-1.0"] in [row[:4] for row in rows]
    assert ["figure", "4", "20", "MIT"] in [row[:4] for row in rows]


def test_a_variable_names_the_folder_of_models(
    shell: Shell, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models").mkdir()
    for place, code in ((folder / "models", 0), ("", 1)):
        monkeypatch.setenv("SHAPESPACE_MODELS_DIR", str(place))
        assert ("small " in shell("models")) is (code == 0)
        shell("decode", "small", "--out", tmp_path / "shape.glb", code=code)


def test_random_codes_become_files_with_a_table(shell: Shell, model: ShapeModel, tmp_path: Path) -> None:
    out = tmp_path / "new" / "shapes"
    shell("decode", "small", "--random", "11", "--seed", "3", "--out", out, "--mesh", "coarse")
    files = [f"shape-{k:02}.glb" for k in range(11)]
    assert sorted(path.name for path in out.iterdir()) == ["codes.csv", *files]
    rows = table((out / "codes.csv").read_text())
    assert [row["file"] for row in rows] == files
    codes = np.array([[row[name] for name in model.names] for row in rows], np.float32)
    np.testing.assert_array_equal(codes, model.sample(11, seed=3))
    for row, code in zip(rows[:2], codes, strict=False):
        shape = model.decode(code, mesh="coarse")
        np.testing.assert_array_equal(read_arrays(out / row["file"])[0], shape.astype(np.float32))
    before = (out / "codes.csv").read_bytes()
    shell("decode", "small", "--random", "11", "--seed", "4", "--out", out, code=1)
    assert "codes.csv: exists already; --force replaces it" in shell.err
    assert (out / "codes.csv").read_bytes() == before
    shell("decode", "small", "--random", "2", "--format", "obj", "--force", "--out", out)
    assert len(table((out / "codes.csv").read_text())) == 2
    assert (out / "shape-1.obj").exists()


@pytest.mark.parametrize("name", ["shape.ply", "shape.OBJ", "shape.stl"])
def test_one_code_becomes_a_file_of_the_format_in_its_name(
    name: str, shell: Shell, model: ShapeModel, tmp_path: Path
) -> None:
    shell("decode", "models/small", "--latent", CODE, "--quality", "full", "--out", tmp_path / name)
    shape = model.shape(np.array(CODE.split(","), np.float32), quality="full").vertices
    content = MESH_FORMATS[name[-3:].lower()].encode(shape, model.faces, None, model.decoder.surface("fine"))
    assert (tmp_path / name).read_bytes() == content


def test_several_codes_can_be_named_and_one_goes_to_standard_output(
    shell: Shell, model: ShapeModel, tmp_path: Path
) -> None:
    shell("decode", "small", "--latent", "-0.1,9,0", "--latent", CODE, "--bounds", "clamp", "--out", tmp_path)
    found = [[float(row[name]) for name in model.names] for row in table((tmp_path / "codes.csv").read_text())]
    np.testing.assert_allclose(found, [[-0.1, 9 - 2 * np.pi, 0], [0.1, 0.7, 0.4]], rtol=1e-6)
    shell("decode", "small", "--latent", CODE, "--format", "npz", "--out", "-")
    with np.load(io.BytesIO(shell.out)) as file:
        np.testing.assert_array_equal(file["faces"], model.faces)
    assert shell.err == ""
    shell("decode", "small", "--out", tmp_path / "reference.ply")
    np.testing.assert_allclose(read_arrays(tmp_path / "reference.ply")[0], model.vertices, atol=1e-6)
    for code, note in (("0,0,1.3", False), ("0,0,1.9", True)):
        shell("decode", "small", "--latent", code, "--out", tmp_path / "far.obj", "--force")
        assert ("far.obj: the code lies far outside the bounds" in shell.err) is note


def test_meshes_become_a_table_and_a_bad_one_stops_nothing(shell: Shell, model: ShapeModel, tmp_path: Path) -> None:
    shape = model.decode([float(x) for x in CODE.split(",")])
    for name, vertices in (("a.ply", shape), ("b.ply", np.random.default_rng(0).permutation(shape))):
        (tmp_path / name).write_bytes(MESH_FORMATS["ply"].encode(vertices, model.faces))
    (tmp_path / "odd.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    files = [tmp_path / name for name in ("a.ply", "odd.obj", "none.ply", "b.ply")]
    good, odd, none, poor = table(shell("encode", "small", *files, "--fixed", '{"2": 0.4}', code=1))
    assert "no code for 2 of 4 files" in shell.err
    assert (good["status"], good["inside_bounds"]) == ("converged", "True")
    assert good["file"] == str(files[0])
    np.testing.assert_allclose([float(good[name]) for name in model.names], [0.1, 0.7, 0.4], atol=1e-3)
    assert float(good["error_mean"]) <= float(good["error_max"]) < 1e-3
    assert [odd["status"], none["status"]] == ["refused", "refused"]
    assert "3 vertices" in odd["reason"]
    assert "can't be read" in none["reason"]
    assert poor["status"] == "poor"
    out = tmp_path / "new" / "codes.csv"  # folders are made
    assert shell("encode", "small", files[0], "--csv", out) == ""
    shell("encode", "small", files[0], "--csv", out, code=1)
    assert "codes.csv: exists already" in shell.err
    assert table(out.read_text())[0]["status"] == "converged"


def test_a_scan_becomes_a_shape_on_the_scan(shell: Shell, model: ShapeModel, tmp_path: Path) -> None:
    turn = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    scan = model.decode([0.1, 0.7, 0.4])[::2] @ turn + [5, 0, 1]
    (tmp_path / "scan.xyz").write_text("\n".join(" ".join(map(str, point)) for point in scan))
    out, answer = tmp_path / "fitted.ply", tmp_path / "fit.json"
    command = ("fit", "small", tmp_path / "scan.xyz", "--out", out, "--json", answer)
    said = shell(*command, "--seed", "2", "--samples", "3", "--distribution", "box", "--fixed", '{"1": 0.7}')
    expected = model.fit_scan(tmp_path / "scan.xyz", seed=2, samples=3, distribution="box", fixed={1: 0.7})
    found = json.loads(answer.read_text())
    assert said.startswith(f"{found['status']}: {found['reason']}\ncode: ")
    np.testing.assert_array_equal(np.array(said.split("code: ")[1].split(","), np.float32), expected.code)
    np.testing.assert_array_equal(np.array(found["latent"], np.float32), expected.code)
    assert found["latent"][1] == 0.7
    assert np.shape(found["samples"]) == (3, 3)
    assert found["placement"]["scale"] == 1
    placed = expected.placement(expected.shape.vertices)
    np.testing.assert_array_equal(read_arrays(out)[0], placed.astype(np.float32))
    assert ("look at the fitted shape" in shell.err) is (found["status"] != "converged")
    shell(*command, code=1)
    assert "exists already" in shell.err
    assert shell(*command, "--force", "--deadline", "1e-9").startswith("deadline: ")
    assert "The status is deadline: look at the fitted shape" in shell.err
    shell(*command, "--force", "--deadline", "1e-9", "--samples", "9" * 15, code=1)
    assert "there is not enough memory" in shell.err


def test_a_page_replaces_files_only_if_it_may(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("mine")
    shell("page", "figure", "--out", tmp_path, code=1)
    assert "index.html: exists already" in shell.err
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]
    shell("page", "figure", "--out", tmp_path, "--force")
    assert "python -m http.server" in shell.err
    assert "mine" not in (tmp_path / "index.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ("decode smaller --out x.glb", 1, "no model smaller here: choose among figure, freaky-torus, small, or name"),
        ("decode none/small --out x.glb", 1, "none/small can't be read: there is no such file or folder"),
        ("decode small --random 2 --out x.glb", 1, "x.glb is one file; for several shapes, name a folder, such as x"),
        ("decode small --random 2 --out -", 1, "standard output is one file; for several shapes, name a folder"),
        ("decode small --out x.xyz", 1, "there is no format 'xyz'; choose among glb, gltf, obj"),
        ("decode small --out models/small/1/README.md", 1, "there is no format 'md'"),
        ("decode small --format obj --out x.glb", 1, "x.glb ends in .glb, but --format is obj"),
        ("decode small --out plain", 1, "plain is a file; name a folder, or a file with an extension"),
        ("page small --out site", 1, "small has no decoder.onnx, which computes shapes in the browser"),
        ("page small --out plain", 1, "plain is a file; name a folder"),
        ("page figure --out -", 2, "'--out': the results can't go to standard output; name a file or folder"),
        ("run a.toml --models -", 2, "'--models': the results can't go to standard output"),
        ("fit small a.ply --out fitted", 1, "fitted has no extension, which tells the format"),
        ("fit small a.ply --json plain", 1, "plain: exists already"),
        ("decode small --latent 0.1 --out x.glb", 1, "Code 0 has 1 number, but small takes 3 ("),
        ("decode small --latent 9,0,0 --bounds reject --out x.glb", 1, "Move it inside"),
        ("decode small --latent 1,x,2 --out x.glb", 2, "is not a list of numbers"),
        ("decode small --latent 1,2,3 --random 2 --out x", 2, "choose --latent or --random"),
        ("decode small --random 0 --out x", 2, "--random"),
        ("decode small", 2, "Missing option '--out'"),
        ("decode small --quality best --out x.glb", 2, "'full'"),
        ("decode small --unknown --out x.glb", 2, "No such option"),
        ("encode small", 2, "Missing argument"),
        ("encode small a.ply --fixed {", 2, "--fixed"),
        ("encode small a.ply --fixed {\"x\":0}", 2, "'--fixed': the key x: needs a whole number."),
        ("encode small a.ply --samples 3", 2, "No such option"),
        ("encode small a.ply --fixed {\"7\":0}", 1, "fixed names coordinate 7"),
        ("fit small none.ply", 1, "none.ply: can't be read"),
        ("fit small models", 1, "models: can't be read: it is a folder, but a file is needed; name the files in it"),
        ("fit small -", 1, "-: can't be read: standard input is not read; save its content in a file first"),
        ("fit small /dev/null", 1, "/dev/null: can't be read: it is a device or a pipe; save its content in a file"),
        ("fit small none.ply --noise 0", 2, "--noise"),
        ("fit small none.ply --deadline soon", 2, "'--deadline': 'soon' is not a number."),
        ("fit small none.ply --fixed 1", 2, "'--fixed': needs an object."),
        ("fit small none.ply --landmarks [{\"vertex\":1,\"position\":[0,0,0],\"sgima\":1}]", 2, "0.sgima: there is no"),
        ("fit small none.ply --samples 3", 2, "--samples: only --json FILE shows the result, so add it."),
        ("fit small none.ply --out - --json -", 2, "--out and --json name one file: name two."),
        ("fit small none.ply --landmarks [{\"vertex\":1}]", 2, "0.position: is not there; add it"),
        ("fit small none.ply --out", 2, "requires an argument"),
        ("fit small a.ply b.ply", 2, "unexpected extra argument"),
        ("models small", 2, "unexpected extra argument"),
        ("decod small", 2, "No such command 'decod'"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_sentence(arguments: str, code: int, says: str, shell: Shell, folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    assert shell(*arguments.split(" "), code=code) == ""
    *usage, sentence = shell.err.splitlines()
    assert says in sentence
    assert sentence.startswith("shapespace")
    assert len(usage) == (code == 2)
    assert sorted(folder.rglob("*")) == before


def test_a_reader_that_has_enough_ends_the_command_quietly(folder: Path) -> None:
    command = [sys.executable, "-m", "shapespace", "decode", "small", "--out", "-", "--format", "obj"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout
        process.stdout.close()
        assert process.stderr
        assert process.stderr.read() == b""
    assert process.returncode == 1
