"""Small runs of the training command: one without faults, and others that must end with the same files."""

import os
import time
from pathlib import Path

import numpy as np
import trimesh

from shapespace.training.stages.run import STAGES
from tests.training.conftest import small_config, train
from tests.training.whole_runs.test_the_same_command import results

#: With a tolerance that networks of three epochs meet.
CONFIG = (
    small_config("bars", "bars.npz", vertices=60, modes=2, log_steps=2, samples=24, part_size=4, epochs=3)
    + "tolerance = 0.01\n"
)
#: Last stage of the runs. tests/training/whole_runs/test_the_same_command.py tests kills in later stages.
LAST = "export" if int(os.environ.get("FAULT_SEEDS", "1")) > 1 else "samples"


def bars(count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Shapes (n, V, 3) of a bar whose two ends bend independently, and its faces."""
    ball = trimesh.creation.icosphere(2, 1.0)
    x, y, z = (ball.vertices * [3.0, 0.8, 0.6]).T
    rng = np.random.default_rng(1)
    shapes = []
    for left, right in np.vstack([np.zeros(2), rng.uniform(-0.8, 0.8, (count - 1, 2))]):
        bend = left * np.clip(-x / 3, 0, 1) ** 2 + right * np.clip(x / 3, 0, 1) ** 2
        shapes.append([x * np.cos(bend) - z * np.sin(bend), y, np.abs(x) * np.sin(bend) + z * np.cos(bend)])
    return np.array(shapes).transpose(0, 2, 1), ball.faces


def write_collection(folder: Path) -> Path:
    """Write a collection and its configuration, and return the configuration's path."""
    vertices, faces = bars()
    np.savez(folder / "bars.npz", vertices=vertices, faces=faces)
    config = folder / "bars.toml"
    config.write_text(CONFIG)
    return config


class Undisturbed:
    """A run without faults, and its files."""

    def __init__(self, folder: Path) -> None:
        self.config = write_collection(folder)
        began = time.monotonic()
        train(self.config, folder / "run", "--until", LAST)
        self.seconds = time.monotonic() - began
        self.results = results(folder / "run")
        self.bytes = sum(path.stat().st_size for path in (folder / "run").rglob("*") if path.is_file())

    def require_the_same(self, run: Path, until: str = LAST) -> None:
        """Assert that a run with faults has the same files up to that stage, bit for bit."""
        stamps = [stage for stage in STAGES if (run / "stages" / f"{stage}.json").exists()]
        assert stamps == list(STAGES)[: list(STAGES).index(until) + 1]
        found = results(run)
        assert [name for name in found if found[name] != self.results.get(name)] == []
        if until == LAST:
            assert found.keys() == self.results.keys()
