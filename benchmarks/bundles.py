"""Bundles on disk, and random codes of their models."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shapespace.model.latent_space import Codes
from shapespace.model.shape_model import ShapeModel


def bundles(folder: Path) -> list[Path]:
    """Return the folders of bundles, sorted by name and version."""
    found = (path.parent for path in folder.glob("*/*/manifest.json"))
    return sorted(found, key=lambda path: (path.parent.name, int(path.name)))


def draw(model: ShapeModel, count: int, spread: float = 1.0) -> Codes:
    """Draw random codes (count, m) in a box ``spread`` times as wide as the bounds."""
    centre = (model.latents.lower + model.latents.upper) / 2
    radius = spread * (model.latents.upper - model.latents.lower) / 2
    codes = centre + radius * np.random.default_rng(0).uniform(-1, 1, (count, len(centre)))
    return model.latents.codes(codes.tolist())[0]
