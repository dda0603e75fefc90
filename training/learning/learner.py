"""The networks of a run, each fitted to the samples once and then read from its file."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel
from scipy import sparse
from torch import Tensor

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.training.learning.baselines import LatentKernel
from shapespace.training.learning.combiners.combiner import CombinerNetwork, choices
from shapespace.training.learning.combiners.correction import JointSamples, Motion, Slopes
from shapespace.training.learning.composite import Composite, TunedNetwork, factor_shapes
from shapespace.training.learning.device import training_device
from shapespace.training.learning.fitting import fit, read_network, save_network
from shapespace.training.learning.layers import PatchBasis, Scaling
from shapespace.training.learning.networks import FactorNetwork, ShapeNetwork, StartNetwork, predict
from shapespace.training.learning.straight import LinearNetwork, straight_composite, straight_start
from shapespace.training.runs.config import Config
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.network_settings import (
    CombinerSettings,
    ConvolutionSettings,
    FitSettings,
    LatentNetworkSettings,
    Recipe,
)
from shapespace.training.runs.sampling import DERIVATIVES, DONE, Collection, Samples, columns, read
from shapespace.training.space.straight_collection import StraightCollection

#: The paper's perceptrons (section 4). It leaves inputs, norm and sizes open; validation codes of Freaky Torus chose
#: them (benchmarks/NOTES.md, The paper's own system). Principal axes of the shapes make an epoch ten times as fast.
PAPER_PERCEPTRON = LatentNetworkSettings(
    hidden=[512, 512, 512, 512],
    normalisation="none",
    skip_degree=0,
    energy=0.9999,
    eta=1e-2,
    fit=FitSettings(schedule="cosine", learning_rate=1e-3, max_epochs=200),
)
#: The paper's own system: its perceptrons, and convolutions on stars. These learn the difference from the affine sum,
#: which the paper does not say.
PAPER = Recipe(
    factors=PAPER_PERCEPTRON,
    combiner=CombinerSettings(
        correction=ConvolutionSettings(
            layers=4,
            width=48,
            edge_channels=0,
            dropout=0,
            normalisation="after",
            fit=FitSettings(schedule="cosine", learning_rate=2e-3, batch_size=2, max_epochs=12),
        ),
        symmetries=False,
        eta=1e-2,
    ),
)


@dataclass(frozen=True)
class TrainingData:
    """Samples that a network is fitted to."""

    inputs: Tensor  # (n, …) inputs of all samples
    z: NDArray[np.float32]  # (n, 2E) NRIC of all samples
    rows: dict[str, IntArray]  # row indices by part: train, validation

    def part(self, name: str) -> tuple[Tensor, Tensor]:
        """Return inputs and NRIC of a part of the samples."""
        rows = self.rows[name]
        return self.inputs[rows], torch.from_numpy(self.z[rows])


class Learner:
    """Fits networks to the samples of a run, and saves each in a file named by a digest of all that determines it.

    So recipes that have a network in common share its file. An unfinished file is continued. A finished file is read,
    and then the samples are not needed. The key of the data stands for the samples and the version of the training
    code. Studies of fewer samples or other seeds are subclasses (``benchmarks.studies``).
    """

    #: Shares of the training codes that joint networks and factor networks learn from. The number of epochs is divided
    #: by the share, so that the number of steps stays the same. Part of the names of the networks' files.
    share = 1.0
    factor_share = 1.0

    def __init__(self, collection: Collection, config: Config, run: RunDirectory, data_key: str) -> None:
        self.collection, self.config, self.run, self.data_key = collection, config, run, data_key
        self.seed = config.networks.seed
        self.histories: dict[str, Any] = {}

    @cached_property
    def joint(self) -> Samples:
        """The joint samples."""
        return read(self.run.samples)

    @cached_property
    def split(self) -> dict[str, IntArray]:
        """Rows of the randomly drawn joint samples: train, validation, test."""
        return {name: np.searchsorted(self.joint.index, index) for name, index in self.run.split.read().items()}

    @cached_property
    def _reference(self) -> FloatArray:
        reference = self.collection.reference
        return nric(reference.vertices, reference.connectivity)

    @cached_property
    def _closing(self) -> sparse.csr_array:
        """Derivatives (q, 2E) of the closing conditions around vertices, at the reference."""
        return Integrability(self.collection.reference.connectivity).jacobian(self._reference)

    def _path(self, kind: str, shares: Sequence[float], *settings: BaseModel) -> Path:
        decides = [self.data_key, shares, self.seed]
        text = json.dumps([*decides, [s.model_dump(mode="json") for s in settings]])
        return self.run.network(f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:12]}")

    def _scaling(self, z: NDArray, eta: float | None = None) -> Scaling:
        return Scaling.of(self._reference, WeightedNorm.of(self.collection.reference, eta=1.0).squared, z, eta)

    @property
    def rows(self) -> dict[str, IntArray]:
        """The split, with the collection's own shapes added to its training rows."""
        return self.split | {"train": np.concatenate([np.flatnonzero(self.joint.index < 0), self.split["train"]])}

    def _fit(
        self, network: ShapeNetwork, data: TrainingData, fitting: FitSettings, path: Path, share: float
    ) -> dict[str, Any]:
        return fit(
            network,
            data.inputs,
            torch.from_numpy(data.z),
            torch.from_numpy(data.rows["train"]),
            torch.from_numpy(data.rows["validation"]),
            fitting.model_copy(update={"max_epochs": round(fitting.max_epochs / share)}),
            path,
            title=self._words(path),
            seed=self.seed,
            device=self.device,
        )

    @cached_property
    def device(self) -> torch.device:
        """Where networks are trained by gradient descent; raises DeviceError if PyTorch does not find the device."""
        return training_device(self.config.networks.device)

    def _words(self, path: Path) -> str:
        """Say for the progress what the network in a file learns."""
        kind, _, number = path.stem.rpartition("-")[0].partition("-")
        if kind == "factor":
            return f"learning factor {list(self.collection.factors)[int(number)]!r}"
        known = {"combiner": "learning how factors join", "joint": "tuning all networks together"}
        return known.get(kind, "learning a network to compare with")

    def _record(self, path: Path, state: dict[str, Any]) -> None:
        self.histories[path.stem] = {k: state[k] for k in ("epoch", "best", "history")}

    def _latent_network(
        self,
        settings: LatentNetworkSettings,
        index: list[int],
        path: Path,
        share: float,
        samples: Callable[[], tuple[Samples, dict[str, IntArray]]],
    ) -> FactorNetwork:
        """Return a network from the latents ``index`` to shapes, read from ``path`` or fitted to samples."""
        coordinates = self.collection.coordinates[index]
        saved = read_network(path) if path.exists() else None
        if saved and saved.done:
            tensors = {k.removeprefix("basis."): v for k, v in saved.tensors.items() if k.startswith("basis.")}
            basis = PatchBasis.blank(tensors) if settings.energy < 1 else None
            network = FactorNetwork(settings, coordinates, Scaling.blank(len(self._reference)), basis)
            network.load_state_dict(saved.tensors)
            network.eval()
            self._record(path, saved.state)
            return network
        torch.manual_seed(self.seed)
        drawn, rows = samples()
        data = TrainingData(torch.as_tensor(drawn.latents[:, index], dtype=torch.float32), drawn.nric, rows)
        z = drawn.nric[rows["train"]]
        scaling, basis = self._scaling(z, settings.eta), None
        if settings.energy < 1:
            y, midpoints = scaling.down(torch.from_numpy(z)).numpy(), self.collection.reference.edge_midpoints
            basis = PatchBasis.fit(y, midpoints, settings.patches, settings.energy, self.seed, settings.support)
        network = FactorNetwork(settings, coordinates, scaling, basis)
        if basis is not None and settings.integrability:
            network.penalise(basis, self._closing, settings.integrability)
        if not saved:
            own, held_out = ((x, network.target(exact)) for x, exact in map(data.part, ("train", "validation")))
            network.fit_skip(*own, held_out)
        self._record(path, self._fit(network, data, settings.fit, path, share))
        return network

    def factor_samples(self, j: int) -> Samples:
        """Return the samples of a factor alone."""
        return read(self.run.factor_samples(j))

    def factor(self, j: int, settings: LatentNetworkSettings) -> FactorNetwork:
        """Return ψ_j, fitted to samples of the factor alone, none of them at a part of a test code."""
        index = list(self.collection.factors.values())[j]

        def samples() -> tuple[Samples, dict[str, IntArray]]:
            own = self.factor_samples(j)
            return own, self.factor_rows(own.index)

        path = self._path(f"factor-{j}", [self.factor_share], settings)
        return self._latent_network(settings, index, path, self.factor_share, samples)

    def factor_rows(self, index: IntArray) -> dict[str, IntArray]:
        """Training and validation rows of a factor's samples with these indices of codes.

        Training codes of the factor include codes beyond the joint samples, and codes whose joint shape failed.
        """
        held_out = {name: np.isin(index, self.joint.index[self.split[name]]) for name in ("validation", "test")}
        train = ~(held_out["validation"] | held_out["test"])
        return {"train": np.flatnonzero(train), "validation": np.flatnonzero(held_out["validation"])}

    @property
    def straight(self) -> bool:
        """Whether the model is made of straight lines, without training."""
        return isinstance(self.collection, StraightCollection)

    def exponentials(self) -> int:
        """Return the number of joint and factor samples behind the composite, including held-out samples."""
        own = (self.factor_rows(self.factor_samples(j).index) for j in range(len(self.collection.factors)))
        return sum(len(rows[part]) for rows in (self.rows, *own) for part in ("train", "validation"))

    def composite(self, recipe: Recipe) -> Composite:
        """Return the composite of a recipe: the ψ_j first, then Ψ, which is fitted to their outputs."""
        indices = list(self.collection.factors.values())
        factors = recipe.factors if isinstance(recipe.factors, list) else [recipe.factors] * len(indices)
        networks = [self.factor(j, settings) for j, settings in enumerate(factors)]
        decides = [*factors, *choices(recipe.combiner.correction)]
        path = self._path("combiner", [self.share, self.factor_share], recipe.combiner, *decides)
        composite = Composite(indices, networks, self._combiner(recipe.combiner, path, indices, networks))
        if recipe.fine_tuning is not None:
            path = self._path("joint", [self.share, self.factor_share], recipe.fine_tuning, recipe.combiner, *decides)
            self._tune(composite, recipe.fine_tuning, path)
        return composite

    def _tune(self, composite: Composite, settings: FitSettings, path: Path) -> None:
        """Train all networks of a composite together on the joint samples, or read them from ``path``."""
        network, saved = TunedNetwork(composite), read_network(path) if path.exists() else None
        if saved and saved.done:
            network.load_state_dict(saved.tensors)
            state = saved.state
        else:
            latents = torch.as_tensor(self.joint.latents, dtype=torch.float32)
            state = self._fit(network, TrainingData(latents, self.joint.nric, self.rows), settings, path, self.share)
        network.eval()
        self._record(path, state)

    def _combiner(
        self, settings: CombinerSettings, path: Path, indices: list[list[int]], networks: list[FactorNetwork]
    ) -> CombinerNetwork:
        """Return Ψ, read from ``path`` or fitted to the outputs of the factor networks at the joint samples."""
        reference = self.collection.reference
        if path.exists():
            saved = read_network(path)
            combiner = CombinerNetwork.load(saved.metadata, reference, saved.tensors)
            combiner.eval()
            self._record(path, saved.state)
            return combiner
        latents = torch.as_tensor(self.joint.latents, dtype=torch.float32)
        data = TrainingData(predict(partial(factor_shapes, networks, indices), latents), self.joint.nric, self.rows)
        if settings.symmetries:
            data = self._with_images(data)
        scaling = self._scaling(self.joint.nric[self.rows["train"]], settings.eta)
        slopes = self._slopes(indices, networks, data.inputs, scaling)
        own = JointSamples(*data.part("train"), scaling, indices, slopes, self._motion("train"))
        held_out = JointSamples(*data.part("validation"), scaling, indices, motion=self._motion("validation"))
        states = {}

        def unfinished(kind: str) -> Path:
            return path.with_name(path.name.replace("combiner", f"combiner-{kind}"))

        def train(network: CombinerNetwork) -> None:
            if descent := network.correction.descent:
                kind = network.settings.kind
                states[kind] = self._fit(network, data, descent, unfinished(kind), self.share)

        torch.manual_seed(self.seed)
        combiner = CombinerNetwork.fit(settings.correction, reference, own, held_out, self.seed, train)
        combiner.eval()
        state = states.get(combiner.settings.kind, {"done": True, "epoch": 0, "best": None, "history": []})
        save_network(path, combiner, state)
        for kind in states:
            unfinished(kind).unlink()
        self._record(path, state)
        return combiner

    def _motion(self, part: str) -> Motion | None:
        """Return the positions of moving features for a part of the joint samples; None without moving features."""
        places = self.collection.places
        if places is None:
            return None
        angles = self.joint.latents[self.rows[part]] * (2 * np.pi / self.collection.coordinates.period)
        return Motion(torch.as_tensor(angles, dtype=torch.float32), places)

    def differentiated(self) -> tuple[IntArray, NDArray[np.float32]]:
        """Return rows (k,) of training samples that have derivatives, and these derivatives (k, m, 2E)."""
        found = columns(self.run.samples / DERIVATIVES, "index", "status", "derivatives")
        if not found:
            return np.empty(0, dtype=int), np.empty((0, 0, 0), np.float32)
        rows = np.searchsorted(self.joint.index, self.run.split.read()["train"][found["index"]])
        some = (found["status"] == DONE) & np.isin(rows, self.rows["train"])
        return rows[some], found["derivatives"][some]

    def _slopes(
        self, indices: list[list[int]], networks: list[FactorNetwork], shapes: Tensor, scaling: Scaling
    ) -> Slopes | None:
        """Return the derivatives of factor shapes and of joint shapes, scaled; None if there are none.

        ``shapes`` (n, J, 2E) are the outputs of the factor networks at the joint samples.
        """
        rows, derivatives = self.differentiated()
        if not len(rows):
            return None
        coordinates = self.collection.coordinates
        radius = torch.as_tensor((coordinates.upper - coordinates.lower) / 2, dtype=torch.float32)
        latents = torch.as_tensor(self.joint.latents[rows], dtype=torch.float32)
        own = torch.empty(derivatives.shape)
        for index, network in zip(indices, networks, strict=True):
            for k, latent in enumerate(index):
                direction = torch.zeros(len(rows), len(index))
                direction[:, k] = radius[latent]
                _, own[:, latent] = torch.autograd.functional.jvp(network, latents[:, index], direction)
        missed = torch.from_numpy(derivatives) * radius[:, None] - own
        return Slopes(scaling.down(shapes[rows]), indices, own * scaling.factor, missed * scaling.factor)

    def _with_images(self, data: TrainingData) -> TrainingData:
        inputs, z, train = data.inputs, data.z, data.rows["train"]
        rows = dict(data.rows)
        for edges in self.collection.symmetries:
            both_halves = np.concatenate([edges, len(edges) + edges])
            rows["train"] = np.concatenate([rows["train"], len(z) + np.arange(len(train))])
            inputs = torch.cat([inputs, data.inputs[train][:, :, both_halves]])
            z = np.concatenate([z, data.z[train][:, both_halves]])
        return TrainingData(inputs, z, rows)

    def main(self) -> Composite:
        """Return the composite that is exported: of the main recipe, or of a straight-line model."""
        if isinstance(self.collection, StraightCollection):
            return straight_composite(self.collection)
        return self.composite(self.config.networks)

    def paper(self) -> Composite:
        """Return the paper's own system, with sizes chosen here."""
        return self.composite(PAPER)

    def monolithic(self) -> Composite:
        """Return our recipe with one factor of all latents, fitted to the joint samples."""
        network = self.joint_network("monolithic", self.config.monolithic)
        index, combiner = list(range(len(self.collection.coordinates))), self.config.networks.combiner
        decides = [self.config.monolithic, *choices(combiner.correction)]
        path = self._path("monolithic-combiner", [self.share], combiner, *decides)
        return Composite([index], [network], self._combiner(combiner, path, [index], [network]))

    def monolithic_paper(self) -> FactorNetwork:
        """Return Φ̃, the paper's fully connected baseline."""
        return self.joint_network("monolithic-paper", self.config.monolithic_paper)

    def joint_network(self, kind: str, settings: LatentNetworkSettings) -> FactorNetwork:
        """Return one network for the whole code, fitted to the joint samples."""
        index = list(range(len(self.collection.coordinates)))
        path = self._path(kind, [self.share], settings)
        return self._latent_network(settings, index, path, self.share, lambda: (self.joint, self.rows))

    def kernel(self) -> LatentKernel:
        """Return kernel ridge regression on the joint samples' latents, in closed form. It is not saved."""
        latents = torch.as_tensor(self.joint.latents, dtype=torch.float32)
        z, rows = torch.from_numpy(self.joint.nric), self.rows
        own, held_out = ((latents[rows[part]], z[rows[part]]) for part in ("train", "validation"))
        at, derivatives = self.differentiated()
        slopes = (latents[at], torch.from_numpy(derivatives)) if len(at) else None
        return LatentKernel(self.collection.coordinates, self._scaling(own[1].numpy()), own, held_out, slopes)

    def start(self) -> StartNetwork | LinearNetwork:
        """Return the start network, fitted to the joint samples in closed form. It is not saved."""
        if isinstance(self.collection, StraightCollection):
            return straight_start(self.collection)
        collection, samples, rows = self.collection, self.joint, self.rows
        network = StartNetwork(collection.coordinates, collection.reference.vertices)
        latents = torch.as_tensor(samples.latents, dtype=torch.float32)
        train, held_out = rows["train"], rows["validation"]
        network.fit(latents[train], samples.vertices[train], (latents[held_out], samples.vertices[held_out]))
        return network
