"""The wheel: `shapespace` is its only top-level package, and it has all that serving the figure needs."""

import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import httpx
import numpy as np
import pytest

from shapespace.model.shape_model import load
from tests.service.conftest import ROOT

SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "shapespace", "service", "training", "models")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
HERE = ("--no-deps", "--no-index", "--no-build-isolation")  # uses installed packages and no network
#: Environment of the programs, without variables that would change Python's or the server's behaviour.
ENVIRONMENT = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "SHAPESPACE_"))}


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def checkout(folder: Path, *left_out: str) -> Path:
    """A copy of the sources as in git: without build products, and with symbolic links kept."""
    folder.mkdir()
    for name in set(SOURCES) - set(left_out):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder)
    return folder


def build(sources: Path) -> Path:
    run(*PIP, "wheel", *HERE, "--wheel-dir", "dist", ".", cwd=sources)
    (wheel,) = (sources / "dist").glob("*.whl")
    return wheel


def content(wheel: Path) -> dict[str, int]:
    """Checksums of files by name, except those of the wheel's metadata."""
    with zipfile.ZipFile(wheel) as archive:
        return {entry.filename: entry.CRC for entry in archive.infolist() if ".dist-info/" not in entry.filename}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(checkout(tmp_path_factory.mktemp("wheel") / "sources"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs' folder of a new environment that takes its dependencies from this one."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
    python = folder / "bin" / "python"
    run(*PIP, "--python", python, "install", *HERE, wheel, cwd=folder.parent)
    (packages,) = folder.glob("lib/python*/site-packages")
    # Only the folder named here is added; .pth files in it are not read, so an editable install is not found.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin"


def test_shapespace_is_alone_at_its_top(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0] for name in names} == {"shapespace", f"{wheel.name.rsplit('-', 3)[0]}.dist-info"}
    assert {"shapespace/py.typed", "shapespace/service/page/index.html", "shapespace/training/report/report.jinja"} <= {
        *names
    }
    models = {tuple(name.split("/")[2:-1]) for name in names if name.startswith("shapespace/models/")}
    assert models == {("figure", "4")}
    own = {
        path.relative_to(ROOT).as_posix()
        for top in ("shapespace", "shapespace/service", "shapespace/training")
        for path in (ROOT / top).resolve().rglob("*.py")
    }
    inside = {re.sub(r"^shapespace/(?=service/|training/)", "", name) for name in names if name.endswith(".py")}
    assert inside == own


@pytest.mark.long
def test_a_wheel_from_the_source_distribution_is_the_same(wheel: Path, tmp_path: Path) -> None:
    sources = checkout(tmp_path / "sources")
    program = "import sys, setuptools.build_meta; setuptools.build_meta.build_sdist(sys.argv[1])"
    run(sys.executable, "-c", program, tmp_path, cwd=sources)
    (archive,) = tmp_path.glob("*.tar.gz")
    run("tar", "--extract", "--file", archive, "--one-top-level=unpacked", cwd=tmp_path)
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    assert not any(path.is_symlink() for path in unpacked.rglob("*"))
    assert content(build(unpacked)) == content(wheel)


def test_the_image_is_built_without_training_and_models(wheel: Path, tmp_path: Path) -> None:
    without = content(build(checkout(tmp_path / "sources", "training", "models")))
    left_out = ("shapespace/training/", "shapespace/models/")
    assert without == {name: crc for name, crc in content(wheel).items() if not name.startswith(left_out)}


def test_a_checkout_without_links_is_refused_in_a_sentence(tmp_path: Path) -> None:
    sources = checkout(tmp_path / "sources", "models")
    link = sources / "shapespace" / "service"
    link.unlink()
    link.write_text("../service")  # as git does where it can't create links
    with pytest.raises(AssertionError, match=r"shapespace/service is a text file where a link to \.\./service should"):
        build(sources)


@pytest.mark.long
def test_type_checkers_know_it(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "user.py").write_text("""
import shapespace
model = shapespace.load("models/figure")
code: str = model.encode("mesh.obj").code
shapespace.lode
""")
    checker = (
        sys.executable,
        "-m",
        "mypy",
        "--python-executable",
        installed / "python",
        "--no-error-summary",
        "user.py",
    )
    told = subprocess.run(checker, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False).stdout
    # Errors in stubs of other libraries don't matter.
    found = [
        line.split(": ", 2)[::2] for line in told.splitlines() if line.startswith("user.py:") and ": error: " in line
    ]
    assert [place for place, _ in found] == ["user.py:4", "user.py:5"], told
    assert "ndarray" in found[0][1]
    assert "lode" in found[1][1]


def test_nothing_else_can_be_imported(installed: Path, tmp_path: Path) -> None:
    program = """
import importlib.util, pathlib, sys
import shapespace.service, shapespace.training
assert pathlib.Path(shapespace.__file__).is_relative_to(sys.prefix), shapespace.__file__
print([name for name in ("geometry", "models", "service", "tests", "training") if importlib.util.find_spec(name)])
"""
    assert run(installed / "python", "-c", program, cwd=tmp_path).strip() == "[]"


def test_the_figure_is_served_from_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    server = subprocess.Popen(
        [installed / "shapespace-serve"],
        cwd=tmp_path,
        env=ENVIRONMENT | {"SHAPESPACE_PORT": "0", "SHAPESPACE_DRAIN": "0"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert server.stdout
        announced = re.search(r"http://\S+", server.stdout.readline())
        assert announced
        with httpx.Client(base_url=announced.group(), timeout=120) as client:
            assert [model["name"] for model in client.get("v1/models").json()["models"]] == ["figure"]
            answer = client.post("v1/models/figure/vertices", json={"latents": [[0.3] * 20]}).raise_for_status()
            assert client.get("").text.startswith("<!doctype html>")
    finally:
        server.send_signal(signal.SIGTERM)
        _, log = server.communicate(timeout=60)
    expected = load(ROOT / "models" / "figure").decode(np.full((1, 20), 0.3))
    np.testing.assert_array_equal(np.array(answer.json()["vertices"], np.float32), expected.astype(np.float32))
    assert "serving the models of the package" in log
    assert not any(tmp_path.iterdir())


def test_the_figure_is_decoded_from_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    assert "figure" in run(installed / "shapespace", "models", cwd=tmp_path)
    run(installed / "shapespace", "decode", "figure", "--random", "1", "--out", "figure.npz", cwd=tmp_path)
    with np.load(tmp_path / "figure.npz") as file:
        expected = load("figure").decode(load("figure").sample(1)[0])
        np.testing.assert_array_equal(file["vertices"], expected.astype(np.float32))


def test_workers_of_a_cluster_need_their_extra_alone(installed: Path, tmp_path: Path) -> None:
    program = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"fastapi", "matplotlib", "onnx", "onnxruntime", "pydantic", "tomlkit", "torch",
                                  "trimesh"}:
            raise ModuleNotFoundError(f"{name} is refused")
sys.meta_path.insert(0, Refuse())
import numpy as np
from shapespace import Material, TriangleMesh
from shapespace.training.runs import sampling, workers
from shapespace.training.space.shell_collection import ShellCollection
corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
mesh = TriangleMesh.from_arrays(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
ends = -np.ones(1), np.ones(1)
collection = ShellCollection(mesh, 0.1 * corners[None], *ends, {"size": [0]}, 4, Material(), 1.0, np.empty((0, 1)))
part = sampling._part(collection, False, np.array([[0.5]]))
assert part["status"] == [sampling.DONE], part["reason"]
"""
    run(installed / "python", "-c", program, cwd=tmp_path)
