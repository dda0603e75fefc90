"""Neural fields: they read codes from factors' shapes, see features from where an edge is, and learn what moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.training.collection.generators.freaky_torus import PAPER, FreakyTorus, edge_permutation
from shapespace.training.learning.combiners import combiner
from shapespace.training.learning.combiners.combiner import CombinerNetwork
from shapespace.training.learning.combiners.correction import Correction, JointSamples, Motion
from shapespace.training.learning.combiners.fields import FieldCorrection
from shapespace.training.learning.fitting import read_network, save_network
from shapespace.training.learning.layers import Scaling
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.network_settings import AutoSettings, FieldSettings

TORUS = FreakyTorus()
FACTORS = list(TORUS.factors.values())
SMALL = FieldSettings(layers=2, width=32, edges=64)


def codes(count: int, seed: int) -> np.ndarray:
    return TORUS.coordinates.uniform(count, np.random.default_rng(seed))


def samples(latents: np.ndarray) -> JointSamples:
    """Return exact joint shapes and factor shapes."""
    factors = np.stack([TORUS.shapes(alone(latents, index)).nric for index in FACTORS], axis=1)
    joint, reference = TORUS.shapes(latents).nric, TORUS.reference
    rest = nric(reference.vertices, reference.connectivity)
    scaling = Scaling.of(rest, WeightedNorm.of(reference, 1.0).squared, joint)
    motion = Motion(torch.as_tensor(latents, dtype=torch.float32), TORUS.places)
    exact = (torch.as_tensor(each).float() for each in (factors, joint))
    return JointSamples(*exact, scaling, FACTORS, motion=motion)


@pytest.fixture(scope="module")
def own() -> JointSamples:
    return samples(codes(300, 0))


@pytest.fixture(scope="module")
def held_out(own: JointSamples) -> JointSamples:
    return replace(samples(codes(40, 1)), scaling=own.scaling)


def network(own: JointSamples, held_out: JointSamples, settings: FieldSettings = SMALL) -> CombinerNetwork:
    torch.manual_seed(0)
    with torch.no_grad():
        return CombinerNetwork.fit(settings, TORUS.reference, own, held_out, 0)


def shaken(network: CombinerNetwork) -> CombinerNetwork:
    """With weights of their own in the last layer, which begins as zero."""
    torch.nn.init.normal_(network.correction.perceptron[-1].weight, std=0.1)
    return network


def test_it_reads_codes_from_shapes_that_it_has_not_seen(own: JointSamples, held_out: JointSamples) -> None:
    field = network(own, held_out).correction
    new = codes(50, 2)
    cosine, sine = field.codes(replace(samples(new), scaling=own.scaling).inputs).double().unbind(dim=2)
    away = np.angle(torch.complex(cosine, sine).numpy() * np.exp(-1j * new))
    error = np.sqrt((away**2).mean(axis=0))
    # Ellipses by waves of all edges; the bump by fewer, of which it covers only some.
    assert (error[:2] < 1e-3).all()
    assert (error[2:] < 0.05).all()


def test_it_begins_as_the_affine_sum(own: JointSamples, held_out: JointSamples) -> None:
    y = held_out.inputs[:3]
    with torch.no_grad():
        torch.testing.assert_close(network(own, held_out).correction(y), y.sum(dim=1))


@pytest.mark.parametrize("relative", [True, False])
def test_symmetric_shapes_look_alike_at_symmetric_edges(
    own: JointSamples, held_out: JointSamples, relative: bool
) -> None:
    """Moved by eight columns; what is not relative, and the factors' shapes, which have other bumps, don't count."""
    field = network(own, held_out, SMALL.model_copy(update={"relative": relative})).correction
    turn = 2 * np.pi * 8 / PAPER.columns
    before, after = held_out.motion.codes[:4], held_out.motion.codes[:4] + turn * torch.tensor([2.0, 0, 1, 0])
    circle = [torch.stack([torch.cos(c), torch.sin(c)], dim=2) for c in (before, after)]
    i, j = np.divmod(np.arange(PAPER.columns * PAPER.rows), PAPER.rows)
    image = edge_permutation(TORUS.reference.connectivity, (i + 8) % PAPER.columns * PAPER.rows + j)
    seen = []
    for known, at in zip(circle, (torch.arange(len(image)), torch.as_tensor(image)), strict=True):
        field.codes = lambda y, known=known: known
        every = field._features(held_out.inputs[:4], at.expand(4, -1))
        seen.append(torch.cat([every[:, :, :40], every[:, :, -field.edges.shape[1] + 2 :]], dim=2))
    assert torch.allclose(*seen, atol=1e-4) == relative


def test_its_loss_is_the_mean_square_error_on_average(own: JointSamples, held_out: JointSamples) -> None:
    combiner = shaken(network(own, held_out))
    y, target = held_out.inputs, combiner.target(held_out.joint)
    with torch.no_grad():
        exact = torch.nn.functional.mse_loss(combiner.correction(y), target)
        drawn = torch.stack([combiner.correction.loss(y, target) for _ in range(60)])
    assert float(drawn.mean()) == pytest.approx(float(exact), abs=4 * float(drawn.std()) / 60**0.5)
    assert 0 < float(drawn.std()) < 0.2 * float(exact)


def descend(combiner: CombinerNetwork, own: JointSamples, steps: int, rate: float) -> None:
    optimiser = torch.optim.Adam(combiner.parameters(), rate)
    y, target = own.inputs, combiner.target(own.joint)
    for _ in range(steps):
        batch = torch.randperm(len(y))[:32]
        optimiser.zero_grad()
        combiner.correction.loss(y[batch], target[batch]).backward()
        optimiser.step()


def test_descent_brings_it_nearer_to_new_shapes_than_the_affine_sum(own: JointSamples, held_out: JointSamples) -> None:
    combiner = network(own, held_out)
    descend(combiner, own, 200, 1e-2)
    wanted = combiner.target(held_out.joint)
    with torch.no_grad():
        left = (combiner.coefficients(held_out.factors) - wanted).square().mean()
    assert left < 0.65 * (held_out.inputs.sum(dim=1) - wanted).square().mean()


class Nothing(Correction):
    """A correction that leaves the affine sum as it is, in the place of the kernel."""

    @classmethod
    def fit(cls, *_: object) -> Nothing:
        return cls({})

    def difference(self, y: torch.Tensor) -> torch.Tensor:
        return 0 * y[:, 0]


@pytest.mark.parametrize(
    ("known", "minutes", "better", "tried", "kind"),
    [
        (True, 30, 1e-3, ["kernel", "field"], "kernel"),
        (True, 30, 0.9, ["kernel", "field"], "field"),
        (True, 0, 99, ["kernel"], "kernel"),
        (False, 30, 99, ["kernel", "convolutions"], "convolutions"),
    ],
)
def test_auto_tries_what_follows_a_bump(
    own: JointSamples,
    held_out: JointSamples,
    monkeypatch: pytest.MonkeyPatch,
    known: bool,
    minutes: float,
    better: float,
    tried: list[str],
    kind: str,
) -> None:
    """``auto`` tries a field if the collection knows where codes move features, and convolutions otherwise.

    It is chosen, as it was after its training, by the share of the kernel's error that it has to reach, and not tried
    where the kernel is slow.
    """
    monkeypatch.setitem(combiner.CORRECTIONS, "kernel", Nothing)
    monkeypatch.setattr(combiner, "FieldSettings", lambda: SMALL)
    monkeypatch.setattr(combiner, "AUTO", replace(combiner.AUTO, better=better))
    trained: list[str] = []

    def train(combiner: CombinerNetwork) -> None:
        trained.append(combiner.settings.kind)
        if combiner.settings.kind == "field":
            descend(combiner, own, 60, 1e-2)

    if not known:
        own = replace(own, factors=own.factors[:130], joint=own.joint[:130], motion=None)
        held_out = replace(held_out, factors=held_out.factors[:10], joint=held_out.joint[:10], motion=None)
    found = CombinerNetwork.fit(AutoSettings(minutes=minutes), TORUS.reference, own, held_out, 0, train)
    assert trained == list(found.tried) == tried
    assert found.settings.kind == kind


def test_it_comes_back_from_its_file(own: JointSamples, held_out: JointSamples, tmp_path: Path) -> None:
    combiner = shaken(network(own, held_out))
    save_network(tmp_path / "n.safetensors", combiner, {"done": True})
    saved = read_network(tmp_path / "n.safetensors")
    again = CombinerNetwork.load(saved.metadata, TORUS.reference, saved.tensors)
    with torch.no_grad():
        assert torch.equal(again(held_out.factors[:2]), combiner(held_out.factors[:2]))


def test_it_refuses_collections_that_know_no_places(own: JointSamples) -> None:
    unknown: Any = replace(own, motion=None)
    with pytest.raises(ValueError, match="where its coordinates are on the surface"):
        FieldCorrection.fit(SMALL, TORUS.reference, unknown, unknown, 0)


@pytest.mark.parametrize(("y", "count"), [(torch.zeros(200, 50), 1), (torch.eye(200), 198), (torch.ones(9, 1), 1)])
def test_a_quick_look_counts_principal_components(y: torch.Tensor, count: int) -> None:
    assert combiner._components(y) == count
