"""A small run of the real command, whose files several tests read, and small collections."""

import fcntl
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.exponential import exponential
from shapespace.shell.space import ShellSpace

TINY = """
[collection]
generator = "freaky-torus"

[samples]
count = 60
factor_counts = [60, 60, 120]
part_size = 20

[[networks.factors]]
hidden = [16]
energy = 0.999
fit = { batch_size = 8, max_epochs = 12 }

[[networks.factors]]
hidden = [16]
energy = 0.999
fit = { batch_size = 8, max_epochs = 12 }

[[networks.factors]]
hidden = [16]
fourier = 4
skip_orders = [6, 3]
patches = 8
energy = 0.95
fit = { batch_size = 20, max_epochs = 6 }

[networks.combiner.correction]
kind = "convolutions"
neighbourhood = "flaps"
width = 8
layers = 2
products = 2
fit = { batch_size = 8, max_epochs = 7 }

[monolithic]
hidden = [16]
fit = { batch_size = 8, max_epochs = 3 }

[monolithic_paper]
hidden = [16]
fit = { batch_size = 8, max_epochs = 3 }

[evaluation]
baselines = true
grid_nodes = 4
reconstructions = 2

[export]
decoder = false
name = "tiny-torus"
title = "Tiny torus"
description = "A run for the tests."
licence = "MIT"
"""

#: Steps of the exponentials of bent meshes.
STEPS = 4


def small_config(
    name: str,
    data: str,
    *,
    vertices: int,
    modes: int,
    log_steps: int,
    samples: int,
    part_size: int,
    epochs: int,
    correction: str = 'kind = "kernel"',
    evaluation: str = "reconstructions = 2",
    skip_degree: int = 2,
) -> str:
    """The configuration of a run on meshes that takes seconds; monolithic networks are fitted as factors are."""
    fit = f"fit = {{ batch_size = 16, max_epochs = {epochs} }}"
    return f"""
[collection]
data = "{data}"
coarse_vertices = {vertices}

[modes]
count = {modes}
log_steps = {log_steps}

[factors]
count = 2

[samples]
count = {samples}
steps = {log_steps}
part_size = {part_size}

[networks.factors]
hidden = [16]
skip_degree = {skip_degree}
{fit}

[networks.combiner]
correction = {{ {correction} }}

[monolithic]
hidden = [16]
{fit}

[monolithic_paper]
hidden = [16]
{fit}

[evaluation]
{evaluation}

[export]
decoder = false
name = "{name}"
title = "{name.capitalize()}"
description = "A run for the tests."
licence = "MIT"
"""


def command(config: Path, out: Path, *more: str) -> list[str]:
    """The command that trains, with its bundles beside its results."""
    places = ["--out", str(out), "--models", str(out / "models")]
    return [sys.executable, "-m", "shapespace.training", "run", str(config), *places, *more]


def train(config: Path, out: Path, *more: str) -> str:
    """Run the command until it has succeeded, and return what it wrote on standard output."""
    done = subprocess.run(command(config, out, *more), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(autouse=True)
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no number of workers is given, all is computed in this process: small work is done before others start."""
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")


class Said:
    """Runs ``shapespace-train`` in this process, which saves importing its libraries again; returns its output.

    Attributes:
        errors: what the last one wrote to standard error.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys, self.errors = monkeypatch, capsys, ""

    def __call__(self, *arguments: str | Path, code: int = 0) -> str:
        from shapespace.training.__main__ import main  # not needed by processes that only import this file

        self._monkeypatch.setattr(sys, "argv", ["shapespace-train", *map(str, arguments)])
        assert main() == code
        captured = self._capsys.readouterr()
        self.errors = captured.err
        assert "Traceback" not in captured.err
        assert "Errno" not in captured.err
        return captured.out + captured.err


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Said:
    return Said(monkeypatch, capsys)


def shared_run(factory: pytest.TempPathFactory, name: str, write: Callable[[Path], Path]) -> Path:
    """A run of the real command that all processes of a test session share.

    Args:
        factory: pytest's factory of folders.
        name: name of the folder.
        write: writes the collection and its configuration into the folder, and returns the configuration's path.
    """
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            folder.mkdir()
            (folder / "said.txt").write_text(train(write(folder), folder / "run"))
    return folder / "run"


def write_tiny(folder: Path) -> Path:
    (folder / "tiny.toml").write_text(TINY)
    return folder / "tiny.toml"


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on the torus; not to be written to."""
    return shared_run(tmp_path_factory, "tiny", write_tiny)


@pytest.fixture(scope="module")
def ellipsoid() -> TriangleMesh:
    """A long ellipsoid of 42 vertices."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    return TriangleMesh.from_arrays(ball.vertices * [3, 1, 1], ball.faces)


def bent(mesh: TriangleMesh, shares: Iterable[float]) -> np.ndarray:
    """A mesh bent to one side or the other: exponentials (n, V, 3) of multiples of one field, in `STEPS` steps."""
    space, x = ShellSpace(mesh), mesh.vertices
    bend = without_rigid_motion(np.stack([0 * x[:, 0], 0 * x[:, 0], 0.25 * x[:, 0] ** 2], axis=1), x)
    paths = [exponential(space, x, share * bend, STEPS) for share in shares]
    assert all(path.converged for path in paths)
    return np.stack([path.vertices[-1] for path in paths])


@pytest.fixture(scope="module")
def blends(ellipsoid: TriangleMesh) -> tuple[TriangleMesh, np.ndarray]:
    """The ellipsoid at unit area, and 12 blend shapes (12, V, 3): sums of three local displacements."""
    size, rng = np.sqrt(ellipsoid.area), np.random.default_rng(5)
    x = ellipsoid.vertices / size
    centres = x[[3, 20, 40]]
    bumps = np.exp(-((np.linalg.norm(x - centres[:, None], axis=2) / 0.15) ** 2))[:, :, None]
    fields = 0.17 * bumps * rng.normal(size=(3, 1, 3))
    weights = rng.uniform(-1, 1, (12, 3))
    return ellipsoid.with_vertices(x), x + np.tensordot(weights, fields, axes=1)
