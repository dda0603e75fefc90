"""The paper's own system (section 4) for a committed run of a generator that was measured without it.

``python -m benchmarks.paper NAME …`` draws the run's samples again, which a generator reproduces up to rounding. It
trains the paper's factor networks and convolutions on them, and its monolithic network of the same sizes. R² on the
run's own test codes and fresh codes goes to ``runs/NAME-paper/evaluation.json``, next to the figures of the run's other
models. ``benchmarks.bundled`` writes the page. An interrupted call can be continued.
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import ROOT, write_figures
from shapespace.training.learning.composite import Composite
from shapespace.training.learning.evaluation import HeldOutSamples, Model, r_squared, size_bytes
from shapespace.training.learning.learner import PAPER, PAPER_PERCEPTRON
from shapespace.training.learning.networks import FactorNetwork, predict
from shapespace.training.runs.config import load
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.network_settings import LatentNetworkSettings, Recipe
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.run import execute
from shapespace.training.stages.stage import Run

#: Largest difference between R² of the kernel on codes now and before, since rounding differs between machines.
ROUNDING = 1e-6


#: Composites, or networks of the whole code, by their names in ``evaluation.json``.
Systems = Mapping[str, Recipe | LatentNetworkSettings]
SYSTEMS: Systems = {"paper": PAPER, "monolithic_chosen": PAPER_PERCEPTRON}


class OtherSamplesError(ValueError):
    """The samples differ from the samples of the stored figures."""


def measure(run: Run, evaluation: dict[str, Any], systems: Systems) -> None:
    """Train systems on the samples of a run, and add their figures to an ``evaluation.json`` of the same run.

    Args:
        run: run of a generator; new, or with samples and networks of an earlier call.
        evaluation: figures of its other models, changed in place. ``NAME_factors`` receives R² of the factor networks
            of a system.
        systems: settings by name.

    Raises:
        OtherSamplesError: kernel ridge regression, which has a closed form, has another R² than before.
    """
    execute(run, "samples", keep_going=True)
    learner, fresh, collection = learner_of(run), evaluation["fresh"], run.collection
    test = HeldOutSamples.of(learner)
    codes = collection.coordinates.uniform(fresh["codes"], np.random.default_rng(fresh["seed"]))
    z, latents = collection.shapes(codes).nric, torch.as_tensor(codes, dtype=torch.float32)

    def reached(model: Model) -> tuple[dict[str, float], dict[str, float]]:
        return test.r2(model), r_squared(predict(model, latents).numpy(), z, test.norm)

    for now, where in zip(reached(learner.kernel()), (evaluation, fresh), strict=True):
        if abs(now["total"] - (before := where["r2"]["kernel"]["total"])) > ROUNDING:
            raise OtherSamplesError(f"{run.directory.folder}: the kernel has {now['total']}, and had {before}")
    for system, settings in systems.items():
        model: Composite | FactorNetwork
        if isinstance(settings, Recipe):
            model = learner.composite(settings)
        else:
            model = learner.joint_network("monolithic-paper", settings)
        evaluation["r2"][system], fresh["r2"][system] = reached(model)
        evaluation["sizes"][system] = size_bytes(model)
        if isinstance(model, Composite):
            own = predict(model.factor_shapes, latents).numpy()
            evaluation[f"{system}_factors"] = {
                name: r_squared(own[:, j], collection.shapes(alone(codes, index)).nric, test.norm)
                for j, (name, index) in enumerate(collection.factors.items())
            }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "results", help="folder of the runs")
    parser.add_argument("names", nargs="+", help="folders of runs/")
    given = parser.parse_args()
    for name in given.names:
        record, file = ROOT / "runs" / name, ROOT / "runs" / f"{name}-paper" / "evaluation.json"
        evaluation = json.loads((file if file.exists() else record / "evaluation.json").read_text())
        config = record / "config.toml"
        measure(
            Run(given.out / name, *load(config, stored=config), given.out / "models"),
            evaluation,
            SYSTEMS,
        )
        write_figures(file, evaluation)


if __name__ == "__main__":
    main()
