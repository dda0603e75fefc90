"""A collection of textured bars in several parts, and one run of the real command on it."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from shapespace.mesh.rigid_motion import align
from shapespace.training.runs.config import load
from shapespace.training.stages.stage import Run
from tests.surfaces import ball, with_parts, write_files
from tests.training.conftest import shared_run, small_config

CONFIG = small_config(
    "bars",
    "meshes",
    vertices=120,
    modes=3,
    log_steps=4,
    samples=60,
    part_size=10,
    epochs=8,
    correction='kind = "kernel", coefficients = 4',
    evaluation="baselines = true\ngrid_nodes = 5\ngrid_size = 30\nreconstructions = 4",
)
SPHERE, SURFACE = with_parts(ball())
EYE, BAR, NAIL = (np.unique(SURFACE.corners[np.repeat(SURFACE.objects.of == k, SURFACE.sizes)]) for k in range(3))


def bars(count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """A thick bar in several poses, far from the origin and in large units, whose ends bend independently.

    The files have textured quads, with an eye and a nail as separate parts; returned are their triangles.
    """
    rest = SPHERE * [300.0, 80.0, 60.0]
    centre = rest[EYE].mean(axis=0)
    rest[EYE] = centre + 20 * (SPHERE[EYE] - SPHERE[EYE].mean(axis=0))
    rng = np.random.default_rng(1)
    shapes = []

    def bent(points: np.ndarray, left: float, right: float, twist: float) -> np.ndarray:
        x, y, z = points.T
        bend = left * np.clip(-x / 300, 0, 1) ** 2 + right * np.clip(x / 300, 0, 1) ** 2
        turn = 0.5 * twist * np.clip(x / 300, 0, 1)
        y, z = np.cos(turn) * y - np.sin(turn) * z, np.sin(turn) * y + np.cos(turn) * z
        x, z = x * np.cos(bend) - z * np.sin(bend), np.abs(x) * np.sin(bend) + z * np.cos(bend)
        return np.stack([1000 + x, y, z], axis=1)

    for pose in np.vstack([np.zeros(3), rng.uniform(-0.8, 0.8, (count - 1, 3))]):
        shape = bent(rest, *pose)
        # An eye is rigid and follows the skin around it.
        shape[EYE] = align(rest[EYE], shape[EYE])
        shapes.append(shape)
    return np.array(shapes), SURFACE.triangles


def write_bars(folder: Path) -> Path:
    """Write the meshes and their configuration, and return the configuration's path."""
    (folder / "meshes").mkdir(parents=True)
    for k, shape in enumerate(bars()[0]):
        path = folder / "meshes" / f"bar{k}.obj"
        write_files(path, shape, SURFACE)
        path.write_text(path.read_text() + "\nv 1 2 3\n")  # a vertex in no face, as exporters leave them
    config = folder / "bars.toml"
    config.write_text(CONFIG)
    return config


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished run; not to be written to."""
    return shared_run(tmp_path_factory, "bars", write_bars)


@pytest.fixture
def folder(run: Path) -> Path:
    """The folder of the meshes, the configuration and the run."""
    return run.parent


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Run:
    """A copy of the finished run that a test may write to."""
    folder = shutil.copytree(run, tmp_path / "run")
    return Run(folder, *load(folder / "config.toml"), folder / "models")
