"""Small runs of the training command: one without faults, and others that must end with the same files."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh

from shapespace.training.stages.run import STAGES
from tests.training.conftest import command
from tests.training.whole_runs.test_collection import results

CONFIG = """
[collection]
data = "bars.npz"
coarse_vertices = 60

[modes]
count = 2
log_steps = 2

[factors]
count = 2

[samples]
count = 24
steps = 2
part_size = 4

[networks.factors]
hidden = [16]
skip_degree = 2
fit = { batch_size = 16, max_epochs = 3 }

[networks.combiner]
correction = { kind = "kernel" }

[monolithic]
hidden = [16]
fit = { batch_size = 16, max_epochs = 3 }

[monolithic_paper]
hidden = [16]
fit = { batch_size = 16, max_epochs = 3 }

[evaluation]
reconstructions = 2

[export]
name = "bars"
title = "Bars"
description = "A run for the tests."
licence = "MIT"
tolerance = 0.01
"""


#: Last stage of the runs. tests/training/whole_runs/test_collection.py tests kills in later stages.
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


def train(
    config: Path, out: Path, *more: str, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command until it ends or fails."""
    return subprocess.run(command(config, out, *more), capture_output=True, text=True, check=False, env=env)


class Undisturbed:
    """A run without faults, and its files."""

    def __init__(self, folder: Path) -> None:
        self.config = write_collection(folder)
        began = time.monotonic()
        done = train(self.config, folder / "run", "--until", LAST)
        assert done.returncode == 0, done.stderr
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
