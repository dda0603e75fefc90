"""The networks stage: factor networks, combiner, monolithic baseline and the rows of the ablation, from samples."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel
from torch import Tensor

from geometry.mesh import IntArray
from geometry.nric import WeightedNorm, nric
from training.config import CombinerSettings, Config, FitSettings, LatentNetworkSettings
from training.fitting import fit, predict
from training.networks import (
    CombinerNetwork,
    FactorNetwork,
    MonolithicNetwork,
    PatchBasis,
    Scaling,
    ShapeNetwork,
    edge_midpoints,
)
from training.sampling import Collection, Samples, read


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

    Two rows that share a network share its file, and a finished or half-finished file is continued, not repeated.
    """

    def __init__(self, collection: Collection, config: Config, folder: Path, data_key: str) -> None:
        self.collection, self.config, self.run, self._data_key = collection, config, folder, data_key
        self.joint = read(folder / "samples")
        with np.load(folder / "samples" / "split.npz") as file:
            self.split: dict[str, IntArray] = dict(file)
        reference = collection.reference
        self._reference = nric(reference.vertices, reference.connectivity)
        self._weights = WeightedNorm.of(reference, eta=1.0).squared
        (folder / "networks").mkdir(exist_ok=True)
        self.histories: dict[str, Any] = {}

    def _path(self, kind: str, *settings: BaseModel) -> Path:
        decides = [self._data_key, self.config.networks.seed, [s.model_dump(mode="json") for s in settings]]
        text = json.dumps(decides)
        return self.run / "networks" / f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.safetensors"

    def _scaling(self, z: NDArray) -> Scaling:
        return Scaling.of(self._reference, self._weights, z)

    def _fit(
        self, network: ShapeNetwork, inputs: Tensor, z: NDArray, rows: dict[str, IntArray], fitting: FitSettings,
        path: Path,
    ) -> None:  # fmt: skip
        title = path.stem.rpartition("-")[0]
        state = fit(
            network,
            inputs,
            torch.from_numpy(z),
            torch.from_numpy(rows["train"]),
            torch.from_numpy(rows["validation"]),
            fitting,
            path,
            title,
            self.config.networks.seed,
        )
        self.histories[path.stem] = {k: state[k] for k in ("epoch", "best", "history")}

    def _latent_network(
        self, kind: type[FactorNetwork], settings: LatentNetworkSettings, index: list[int], samples: Samples,
        rows: dict[str, IntArray], path: Path,
    ) -> FactorNetwork:  # fmt: skip
        seed = self.config.networks.seed
        torch.manual_seed(seed)
        train = rows["train"]
        scaling = self._scaling(samples.nric[train])
        basis = None
        if settings.energy is not None:
            y = scaling.down(torch.from_numpy(samples.nric[train])).numpy()
            basis = PatchBasis.fit(
                y, edge_midpoints(self.collection.reference), settings.patches, settings.energy, seed
            )
        network = kind(settings, self.collection.coordinates[index], scaling, basis)
        latents = torch.as_tensor(samples.latents[:, index], dtype=torch.float32)
        if not path.exists():
            network.fit_skip(latents[train], network.target(torch.from_numpy(samples.nric[train])))
        self._fit(network, latents, samples.nric, rows, settings.fit, path)
        return network

    def factor(self, j: int, settings: LatentNetworkSettings) -> FactorNetwork:
        """ψ_j, on the factor's own samples, or on the joint ones' subvectors where there are no others."""
        index = list(self.collection.factors.values())[j]
        samples = read(self.run / "samples" / f"factor-{j}")
        if self.config.samples.factor_counts is None:
            # One sample of the factor for each joint sample, in the same order: the same split keeps test codes out.
            rows = self.split
        else:
            count = len(samples.latents)
            held_out = round(self.config.samples.validation_fraction * count)
            rows = {"validation": np.arange(held_out), "train": np.arange(held_out, count)}
        path = self._path(f"factor-{j}", settings)
        return self._latent_network(FactorNetwork, settings, index, samples, rows, path)

    def composite(self, factors: list[LatentNetworkSettings], combiner: CombinerSettings) -> Composite:
        """The ψ_j first, then Ψ on their outputs."""
        networks = [self.factor(j, settings) for j, settings in enumerate(factors)]
        torch.manual_seed(self.config.networks.seed)
        train = self.split["train"]
        reference = self.collection.reference
        network = CombinerNetwork(
            combiner, reference.connectivity, self._scaling(self.joint.nric[train]), len(networks)
        )
        composite = Composite(list(self.collection.factors.values()), networks, network)
        inputs = predict(composite.factor_shapes, torch.as_tensor(self.joint.latents, dtype=torch.float32))
        z, rows = self.joint.nric, self.split
        if combiner.symmetries:
            inputs, z, rows = self._with_images(inputs)
        path = self._path("combiner", combiner, *factors)
        if not path.exists():
            network.fit_pairwise(inputs[rows["train"]], torch.from_numpy(z[rows["train"]]))
        self._fit(network, inputs, z, rows, combiner.fit, path)
        return composite

    def _with_images(self, inputs: Tensor) -> tuple[Tensor, NDArray, dict[str, IntArray]]:
        """Factor shapes, joint shapes and split, with the images of the training samples under each symmetry."""
        z, rows = self.joint.nric, dict(self.split)
        train = self.split["train"]
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
        path = self._path("monolithic", settings)
        return self._latent_network(MonolithicNetwork, settings, index, self.joint, self.split, path)
