"""The networks stage: factor networks, combiner, monolithic baseline and the rows of the ablation, from samples."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel
from torch import Tensor

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.training.learning.crops import Crops
from shapespace.training.learning.fitting import finished, fit, save_network
from shapespace.training.learning.layers import PatchBasis, flaps
from shapespace.training.learning.networks import (
    CombinerNetwork,
    FactorNetwork,
    MonolithicNetwork,
    Scaling,
    ShapeNetwork,
    predict,
)
from shapespace.training.runs.config import CombinerSettings, Config, FitSettings, LatentNetworkSettings
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.sampling import Collection, Samples, read, split


@dataclass(frozen=True)
class Composite:
    """``Φ = Ψ ∘ (ψ_1, …, ψ_J)``.

    Attributes:
        factors: latent indices of each factor.
        networks: the ψ_j.
        combiner: Ψ.
    """

    factors: list[list[int]]
    networks: list[FactorNetwork]
    combiner: CombinerNetwork

    def factor_shapes(self, latents: Tensor) -> Tensor:
        """(n, J, 2E) outputs of the ψ_j."""
        return torch.stack(
            [network(latents[:, index]) for network, index in zip(self.networks, self.factors, strict=True)], dim=1
        )

    def __call__(self, latents: Tensor) -> Tensor:
        """NRIC (n, 2E) of codes (n, m)."""
        return self.combiner(self.factor_shapes(latents))


class Learner:
    """Fits networks on the samples of a run, each into a file named by everything that decides it.

    Two rows that share a network share its file; a half-finished file is continued, and a finished one is read without
    a look at the samples.

    Args:
        collection: what the samples are of.
        config: of the run.
        run: holds the samples, and gets the networks.
        data_key: names the samples and the version of what is learned from them.
        fraction: share of the training codes to learn from. With less the number of epochs grows, so that the number of
            steps stays.
        all_of_factors: whether the factors learn from all of their own samples all the same.
        seed: of the networks, by default the configuration's; another one splits the samples anew too.
    """

    def __init__(
        self,
        collection: Collection,
        config: Config,
        run: RunDirectory,
        data_key: str,
        fraction: float = 1.0,
        all_of_factors: bool = False,
        seed: int | None = None,
    ) -> None:
        self.collection, self.config, self.run = collection, config, run
        self.seed = config.networks.seed if seed is None else seed
        self._data_key, self._fraction = data_key, fraction
        self._factor_fraction = 1.0 if all_of_factors else fraction
        self.histories: dict[str, Any] = {}

    @cached_property
    def joint(self) -> Samples:
        """The joint samples."""
        return read(self.run.samples)

    @cached_property
    def split(self) -> dict[str, IntArray]:
        """Rows of the joint samples: train, validation, test."""
        if self.seed != self.config.networks.seed:
            settings, rng = self.config.samples, np.random.default_rng(self.seed)
            return split(np.arange(len(self.joint.index)), settings.test_fraction, settings.validation_fraction, rng)
        return {name: np.searchsorted(self.joint.index, index) for name, index in self.run.split.read().items()}

    @cached_property
    def _reference(self) -> FloatArray:
        reference = self.collection.reference
        return nric(reference.vertices, reference.connectivity)

    def _path(self, kind: str, fractions: Sequence[float], *settings: BaseModel) -> Path:
        decides = [self._data_key, fractions, self.seed]
        text = json.dumps([*decides, [s.model_dump(mode="json") for s in settings]])
        return self.run.network(f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:12]}")

    def _scaling(self, z: NDArray) -> Scaling:
        return Scaling.of(self._reference, WeightedNorm.of(self.collection.reference, eta=1.0).squared, z)

    @property
    def rows(self) -> dict[str, IntArray]:
        """The split, with the share of it to learn from. Codes are independent, so the first are as good as any."""
        return {
            name: index if name == "test" else index[: max(4, round(self._fraction * len(index)))]
            for name, index in self.split.items()
        }

    def _fit(
        self, network: ShapeNetwork, inputs: Tensor, z: NDArray, rows: dict[str, IntArray], fitting: FitSettings,
        path: Path, fraction: float,
    ) -> dict[str, Any]:  # fmt: skip
        title = path.stem.rpartition("-")[0]
        return fit(
            network,
            inputs,
            torch.from_numpy(z),
            torch.from_numpy(rows["train"]),
            torch.from_numpy(rows["validation"]),
            fitting.model_copy(update={"max_epochs": round(fitting.max_epochs / fraction)}),
            path,
            title,
            self.seed,
        )

    def _load(self, network: ShapeNetwork, path: Path, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        network.load_state_dict(tensors)
        network.eval()
        self._record(path, state)

    def _record(self, path: Path, state: dict[str, Any]) -> None:
        self.histories[path.stem] = {k: state[k] for k in ("epoch", "best", "history")}

    def _latent_network(
        self, kind: type[FactorNetwork], settings: LatentNetworkSettings, index: list[int], path: Path, fraction: float,
        data: Callable[[], tuple[Samples, dict[str, IntArray]]],
    ) -> FactorNetwork:  # fmt: skip
        coordinates = self.collection.coordinates[index]
        if saved := finished(path):
            basis = {k.removeprefix("basis."): v for k, v in saved[1].items() if k.startswith("basis.")}
            blank = PatchBasis.blank(basis) if basis else None
            network = kind(settings, coordinates, Scaling.blank(len(self._reference)), blank)
            self._load(network, path, *saved)
            return network
        torch.manual_seed(self.seed)
        samples, rows = data()
        train = rows["train"]
        scaling = self._scaling(samples.nric[train])
        basis_fitted = None
        if settings.energy < 1:
            y = scaling.down(torch.from_numpy(samples.nric[train])).numpy()
            midpoints = self.collection.reference.edge_midpoints
            basis_fitted = PatchBasis.fit(y, midpoints, settings.patches, settings.energy, self.seed)
        network = kind(settings, coordinates, scaling, basis_fitted)
        latents = torch.as_tensor(samples.latents[:, index], dtype=torch.float32)
        if not path.exists():
            pairs = [
                (latents[part], network.target(torch.from_numpy(samples.nric[part])))
                for part in (train, rows["validation"])
            ]
            network.fit_skip(*pairs[0], pairs[1])
        self._record(path, self._fit(network, latents, samples.nric, rows, settings.fit, path, fraction))
        return network

    def factor_samples(self, j: int) -> Samples:
        """The samples of a factor alone."""
        return read(self.run.factor_samples(j))

    def factor(self, j: int, settings: LatentNetworkSettings) -> FactorNetwork:
        """ψ_j, on the factor's own samples; parts of test codes are never among them."""
        index = list(self.collection.factors.values())[j]

        def data() -> tuple[Samples, dict[str, IntArray]]:
            samples = self.factor_samples(j)
            return samples, self.factor_rows(samples.index)

        path = self._path(f"factor-{j}", [self._factor_fraction], settings)
        return self._latent_network(FactorNetwork, settings, index, path, self._factor_fraction, data)

    def factor_rows(self, index: IntArray) -> dict[str, IntArray]:
        """Which of a factor's samples, at codes of this index, it learns from and is chosen by."""
        rows = self.rows if self._factor_fraction < 1 else self.split
        held_out = np.isin(index, self.joint.index[rows["validation"]])
        if self._factor_fraction < 1:
            train = np.isin(index, self.joint.index[rows["train"]])
        else:
            # Codes beyond the joint ones, and those that have no joint shape, are the factor's own.
            train = ~np.isin(index, self.joint.index[np.concatenate([rows["test"], rows["validation"]])])
        return {"train": np.flatnonzero(train), "validation": np.flatnonzero(held_out)}

    def exponentials(self) -> int:
        """Samples that the composite is learned from and chosen by, joint ones and those of the factors."""
        own = (self.factor_rows(self.factor_samples(j).index) for j in range(len(self.collection.factors)))
        return sum(len(rows[part]) for rows in (self.rows, *own) for part in ("train", "validation"))

    def composite(
        self, factors: Sequence[LatentNetworkSettings] | LatentNetworkSettings, combiner: CombinerSettings
    ) -> Composite:
        """The ψ_j first, then Ψ on their outputs."""
        if isinstance(factors, LatentNetworkSettings):
            factors = [factors] * len(self.collection.factors)
        networks = [self.factor(j, settings) for j, settings in enumerate(factors)]
        torch.manual_seed(self.seed)
        fractions = [self._fraction, self._factor_fraction]
        path = self._path("combiner", fractions, combiner, *factors)
        saved = finished(path)
        scaling = Scaling.blank(len(self._reference)) if saved else self._scaling(self.joint.nric[self.rows["train"]])
        reference = self.collection.reference
        network = CombinerNetwork(combiner, reference.connectivity, scaling, len(networks))
        composite = Composite(list(self.collection.factors.values()), networks, network)
        if saved:
            self._load(network, path, *saved)
            return composite
        inputs = predict(composite.factor_shapes, torch.as_tensor(self.joint.latents, dtype=torch.float32))
        z, rows = self.joint.nric, self.rows
        if combiner.symmetries:
            inputs, z, rows = self._with_images(inputs, rows)
        own, other = ((inputs[part], torch.from_numpy(z[part])) for part in (rows["train"], rows["validation"]))
        corrected = combiner.kernel or combiner.polynomial
        convolutions = self._path("convolutions", fractions, combiner, *factors) if corrected else path
        if not convolutions.exists():
            network.fit_pairwise(*own, other)
        state: dict[str, Any] = {"done": True, "epoch": 0, "best": None, "history": []}
        if combiner.layers:
            if combiner.crop:
                network.crops = Crops(
                    reference.edge_midpoints, flaps(reference.connectivity), combiner.crop, combiner.layers
                )
            state = self._fit(network, inputs, z, rows, combiner.fit, convolutions, self._fraction)
        network.eval()
        if corrected:
            # Last, because on the samples it has learned from it leaves too little for others to learn.
            network.fit_correction(combiner, reference.edge_midpoints, own, other, self.seed)
            save_network(path, network, state)
        self._record(path, state)
        return composite

    def _with_images(self, inputs: Tensor, rows: dict[str, IntArray]) -> tuple[Tensor, NDArray, dict[str, IntArray]]:
        """Factor shapes, joint shapes and rows, with the images of the training samples under each symmetry."""
        z, rows, train = self.joint.nric, dict(rows), rows["train"]
        for edges in self.collection.symmetries:
            both_halves = np.concatenate([edges, len(edges) + edges])
            rows["train"] = np.concatenate([rows["train"], len(z) + np.arange(len(train))])
            inputs = torch.cat([inputs, inputs[train][:, :, both_halves]])
            z = np.concatenate([z, self.joint.nric[train][:, both_halves]])
        return inputs, z, rows

    def main(self) -> Composite:
        """The recipe that is exported."""
        return self.composite(self.config.networks.factors, self.config.networks.combiner)

    def variants(self) -> dict[str, Composite]:
        """A composite for each row of the ablation."""
        networks = self.config.networks
        return {
            name: self.composite(variant.factors or networks.factors, variant.combiner or networks.combiner)
            for name, variant in self.config.variants.items()
        }

    def monolithic(self) -> FactorNetwork:
        """The fully connected baseline on the joint samples."""
        settings = self.config.monolithic
        index = list(range(len(self.collection.coordinates)))
        path = self._path("monolithic", [self._fraction], settings)
        return self._latent_network(
            MonolithicNetwork, settings, index, path, self._fraction, lambda: (self.joint, self.rows)
        )
