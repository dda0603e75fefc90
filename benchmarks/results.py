"""docs/results.md: every collection from its meshes to the figures of the paper's tables, in one command.

Each collection is a run of its own under ``--out``, so that what is done is not done again, and a killed call goes on
where it was. The bundles go beside the runs: they hold the collections' geometry.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from benchmarks import limits, space
from training.config import Config, load
from training.files import write_json
from training.pipeline import Run, execute, learner_of

ROOT = Path(__file__).parents[1]
CONFIGS = ROOT / "examples"
#: Collections of real meshes, in the order of the tables.
COLLECTIONS = ("hand", "faces", "samba", "makehuman", "horse", "hippocampus")
#: Models of our own, whose runs leave the bundles that are committed.
OWN = ("freaky-torus", "figure")
#: The hand once more without what the method rests on.
CONTRASTS = ("hand-pga", "hand-one-factor")
SPECIAL = {"limits": ("hand", "samba")}


class Row:
    """A run with everything that was measured on it."""

    def __init__(self, name: str, run: Run) -> None:
        self.name, self.run = name, run

    def __getattr__(self, name: str) -> Any:
        """What a stage or a study left as JSON: ``ingest``, ``modes``, ``factors``, ``evaluation``, ``space``, ``limits``."""
        path = self.run.folder / f"{name}.json"
        if not path.exists():
            raise AttributeError(name)
        value = json.loads(path.read_text())
        setattr(self, name, value)
        return value


def config_path(name: str) -> Path:
    """Of a collection or of a model of our own."""
    return CONFIGS / f"{name}.toml" if name in OWN else CONFIGS / "collections" / f"{name}.toml"
