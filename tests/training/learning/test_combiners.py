"""Combiners: every kind of correction learns how factors interact, from the shapes of factors alone."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from torch import nn

from shapespace.bundle.schema import COMBINER
from shapespace.coordinates.nric import NRICJacobian, nric
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.torch.networks import TorchNetwork
from shapespace.training.learning.combiners import kernels
from shapespace.training.learning.combiners.combiner import CORRECTIONS, CombinerNetwork, choices
from shapespace.training.learning.combiners.convolutions import (
    ConvolutionCorrection,
    EdgeConvolution,
    Flaps,
    Star,
    flaps,
)
from shapespace.training.learning.combiners.correction import JointSamples, Slopes, SurfaceGaps
from shapespace.training.learning.combiners.kernels import KernelCorrection
from shapespace.training.learning.combiners.patches import LEARNING, _updated, learned_metric
from shapespace.training.learning.composite import affine_sum
from shapespace.training.learning.export import to_onnx
from shapespace.training.learning.fitting import read_network, save_network
from shapespace.training.runs.network_settings import (
    AutoSettings,
    ConvolutionSettings,
    DenseSettings,
    KernelSettings,
    PaperSettings,
    ProductSettings,
)
from tests.training.learning.conftest import noisy, scaling

AROUND = {"star": Star, "flaps": Flaps}


@pytest.mark.parametrize("mesh", ["ball", "sheet"])
def test_flaps_are_the_other_edges_of_the_two_faces_in_order(mesh: str, request: pytest.FixtureRequest) -> None:
    connectivity: Connectivity = request.getfixturevalue(mesh).connectivity
    index = {tuple(e): k for k, e in enumerate(connectivity.edges.tolist())}
    table = flaps(connectivity)
    for e, (i, j) in enumerate(connectivity.edges.tolist()):
        for side in (0, 1):
            apex = connectivity.edge_opposite[e, side]
            expected = [len(index)] * 2 if apex < 0 else [index[tuple(sorted((end, apex)))] for end in (i, j)]
            assert table[e, 2 * side : 2 * side + 2].tolist() == expected


def star(connectivity: Connectivity) -> np.ndarray:
    """(E, E): 1 where two different edges share a vertex."""
    a, b = connectivity.edges[:, None, :, None], connectivity.edges[None, :, None, :]
    shared = (a == b).any(axis=(2, 3))
    return shared & ~np.eye(len(shared), dtype=bool)


@pytest.mark.parametrize("neighbourhood", ["star", "flaps"])
@pytest.mark.parametrize("mesh", ["ball", "sheet"])
def test_a_convolution_is_the_paper_s_sum_in_training_and_as_exported(
    mesh: str, neighbourhood: str, request: pytest.FixtureRequest
) -> None:
    connectivity: Connectivity = request.getfixturevalue(mesh).connectivity
    torch.manual_seed(0)
    convolution = EdgeConvolution(AROUND[neighbourhood](connectivity), 3, 5).double()
    x = torch.randn(connectivity.edge_count, 2, 3, dtype=torch.float64)
    if neighbourhood == "star":
        shared = torch.from_numpy(star(connectivity)).double()
        around = convolution.other(torch.einsum("ef,fnc->enc", shared, x))
    else:
        padded = torch.cat([x, torch.zeros_like(x[:1])])
        parts = convolution.other.weight.split(3, dim=1)
        around = sum(padded[column] @ w.T for column, w in zip(flaps(connectivity).T, parts, strict=True))
    expected = convolution.own(x) + around
    torch.testing.assert_close(convolution(x), expected)
    exported = torch.export.export(convolution, (x,)).module()
    torch.testing.assert_close(exported(x), expected)


@pytest.mark.parametrize("neighbourhood", ["star", "flaps"])
def test_the_gradient_of_a_convolution_is_right(sheet: TriangleMesh, neighbourhood: str) -> None:
    convolution = EdgeConvolution(AROUND[neighbourhood](sheet.connectivity), 2, 2).double()
    x = torch.randn(sheet.connectivity.edge_count, 2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(convolution, (x,))


def fitted(mesh: TriangleMesh, settings: Any, factors: torch.Tensor, z: torch.Tensor, own: int) -> CombinerNetwork:
    """Fit a combiner in closed form to the first ``own`` samples; the others choose its settings."""
    scale = scaling(mesh, z.numpy())
    parts = (
        JointSamples(factors[part], z[part], scale, [[0]] * factors.shape[1]) for part in (slice(own), slice(own, None))
    )
    with torch.no_grad():
        return CombinerNetwork.fit(settings, mesh, *parts, 0).eval()


def test_residual_convolutions_begin_as_the_affine_sum(ball: TriangleMesh) -> None:
    z = noisy(ball, 6).astype(np.float32)
    factors = z.reshape(2, 3, -1)
    network = fitted(ball, ConvolutionSettings(width=4), torch.from_numpy(factors), torch.from_numpy(z[:2]), 1)
    with torch.no_grad():
        answer = network(torch.from_numpy(factors)).numpy()
    reference = nric(ball.vertices, ball.connectivity)
    np.testing.assert_allclose(answer, affine_sum(reference, factors), atol=2e-5)


Missed = Callable[[NDArray, NDArray, NDArray, NDArray], NDArray]


def interplay(ball: TriangleMesh, count: int, missed: Missed) -> tuple[torch.Tensor, torch.Tensor]:
    """Return shapes z̄ + a d and z̄ + b e of two factors, and joint shapes: their sum plus ``missed(a, b, f, g)``."""
    rng = np.random.default_rng(0)
    reference = nric(ball.vertices, ball.connectivity)
    d, e, f, g = 0.01 * rng.normal(size=(4, len(reference)))
    a, b = rng.uniform(-1, 1, (2, count, 1))
    factors = np.stack([reference + a * d, reference + b * e], axis=1).astype(np.float32)
    z = (reference + a * d + b * e + missed(a, b, f, g)).astype(np.float32)
    return torch.from_numpy(factors), torch.from_numpy(z)


def cubic(a: NDArray, b: NDArray, f: NDArray, g: NDArray) -> NDArray:
    return a * b * f + a**2 * b * g


def beyond_cubic(a: NDArray, b: NDArray, f: NDArray, g: NDArray) -> NDArray:
    return np.sin(2 * a * b) * a * f


def bilinear(a: NDArray, b: NDArray, f: NDArray, g: NDArray) -> NDArray:
    return a * b * f


KINDS = [
    (ProductSettings(coefficients=1), bilinear, 1e-6),
    (ConvolutionSettings(width=4, products=1), bilinear, 1e-6),
    (KernelSettings(coefficients=3), beyond_cubic, 1e-2),
]


@pytest.mark.parametrize(("settings", "missed", "left"), KINDS, ids=lambda value: getattr(value, "kind", None))
def test_every_correction_finds_an_interplay_from_factors_alone(
    ball: TriangleMesh, settings: Any, missed: Missed, left: float
) -> None:
    """The squared error on new codes is less than ``left`` times the error of the affine sum."""
    x, z = interplay(ball, 260, missed)
    network, unseen = fitted(ball, settings, x[:180], z[:180], 150), slice(180, None)
    with torch.no_grad():
        sums = torch.from_numpy(affine_sum(network.scaling.mean.numpy(), x[unseen].numpy()))
        before = (network.scaling.down(sums) - network.scaling.down(z[unseen])).square().mean()
        after = (network.coefficients(x[unseen]) - network.scaling.down(z[unseen])).square().mean()
    assert after < left * before


@pytest.mark.parametrize(("latents", "tried"), [(120, ["kernel"]), (12, ["kernel", "convolutions"])])
def test_auto_tries_nothing_else_where_shapes_vary_as_much_as_latents_do(
    ball: TriangleMesh, latents: int, tried: list[str]
) -> None:
    """120 directions are many for twelve latents, for 120 they are what is to be expected."""
    rng = np.random.default_rng(0)
    reference = torch.from_numpy(nric(ball.vertices, ball.connectivity)).float()
    varied = rng.normal(size=(240, 120)) @ rng.normal(size=(120, len(reference)))
    z = reference + 0.01 * torch.from_numpy(varied).float()
    scale = scaling(ball, z.numpy())
    own, held_out = (
        JointSamples(z[part, None], z[part], scale, [list(range(latents))]) for part in (slice(200), slice(200, None))
    )
    with torch.no_grad():
        network = CombinerNetwork.fit(AutoSettings(), ball, own, held_out, 0)
        error = float((network.coefficients(held_out.factors) - scale.down(held_out.joint)).square().mean())
    assert list(network.tried) == tried
    assert network.tried[network.settings.kind] == pytest.approx(error, rel=1e-3)
    assert CombinerNetwork.load(network.metadata, ball, network.state_dict()).tried == network.tried


def test_derivatives_teach_a_correction(ball: TriangleMesh) -> None:
    """Derivatives at 12 of 15 samples reduce the error; wrong derivatives increase it."""
    rng, count = np.random.default_rng(0), 12
    reference = nric(ball.vertices, ball.connectivity)
    d, e, f, g = (0.01 * torch.from_numpy(x).float() for x in rng.normal(size=(4, len(reference))))
    codes, middle = torch.from_numpy(rng.uniform(-1, 1, (300, 2))).float(), torch.from_numpy(reference).float()

    def shapes(codes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        a, b = codes.split(1, dim=1)
        return torch.stack([middle + a * d, middle + b * e], dim=1), middle + a * d + b * e + a * b * f + a**2 * b * g

    factors, z = shapes(codes)
    scale, some = scaling(ball, z.numpy()), codes[:count]
    held_out = JointSamples(factors[40:100], z[40:100], scale, [[0], [1]])
    both = [torch.autograd.functional.jvp(shapes, some, along.expand_as(some))[1] for along in torch.eye(2)]
    own = torch.stack([x[:, j] for j, (x, _) in enumerate(both)], dim=1)
    joint = torch.stack([y for _, y in both], dim=1)
    missed = (joint - own) * scale.factor
    slopes = Slopes(scale.down(factors[:count]), [[0], [1]], own * scale.factor, missed)

    def fit(samples: int, slopes: Slopes | None) -> CombinerNetwork:
        own = JointSamples(factors[:samples], z[:samples], scale, [[0], [1]], slopes)
        return CombinerNetwork.fit(KernelSettings(coefficients=3), ball, own, held_out, 0).eval()

    def error(network: CombinerNetwork) -> float:
        with torch.no_grad():
            return float((network.coefficients(factors[100:]) - scale.down(z[100:])).square().mean())

    network, without = fit(15, slopes), error(fit(15, None))
    assert error(network) < 0.6 * without
    assert error(fit(15, replace(slopes, missed=-missed))) > without
    session = onnxruntime.InferenceSession(to_onnx(network, factors[:2], COMBINER))
    (answer,) = session.run(None, {COMBINER.input: factors[100:].numpy()})
    with torch.no_grad():
        difference = torch.from_numpy(answer) - network(factors[100:])
    assert difference.square().mean() < 1e-10 * (scale.up(scale.down(z[100:])) - middle).square().mean()


@pytest.mark.parametrize(
    "settings",
    [settings for settings, _, _ in KINDS] + [PaperSettings(width=4), AutoSettings(), DenseSettings(hidden=[4])],
    ids=lambda s: s.kind,
)
def test_every_correction_comes_back_from_its_file(ball: TriangleMesh, settings: Any, tmp_path: Path) -> None:
    x, z = interplay(ball, 60, cubic)
    network = fitted(ball, settings, x, z, 40)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.1
    save_network(tmp_path / "n.safetensors", network, {"done": True})
    saved = read_network(tmp_path / "n.safetensors")
    assert json.loads(saved.metadata["correction"])["kind"] == network.settings.kind
    again = CombinerNetwork.load(saved.metadata, ball, saved.tensors).eval()
    with torch.no_grad():
        assert torch.equal(again(x), network(x))


@pytest.mark.parametrize(
    "settings", [*(settings for settings, _, _ in KINDS), PaperSettings(width=4)], ids=lambda s: s.kind
)
def test_every_correction_runs_in_pytorch_from_its_onnx_file(ball: TriangleMesh, settings: Any) -> None:
    x, z = interplay(ball, 60, cubic)
    network = fitted(ball, settings, x, z, 40)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.01
    content = to_onnx(network, x[:2], COMBINER)
    (expected,) = onnxruntime.InferenceSession(content).run(None, {COMBINER.input: x[:5].numpy()})
    with torch.no_grad():
        found = TorchNetwork(content, COMBINER, torch.float32)(x[:5])
    torch.testing.assert_close(found, torch.from_numpy(expected), atol=1e-5, rtol=1e-5)


def test_every_kind_has_a_class() -> None:
    assert {settings.kind for settings, _, _ in KINDS} | {"field", "dense", "sum"} == set(CORRECTIONS)
    assert {settings.kind for settings in choices(AutoSettings())} <= set(CORRECTIONS)
    paper = PaperSettings().convolutions
    assert (paper.neighbourhood, paper.residual, paper.dropout, paper.edge_channels) == ("star", False, 0.1, 0)
    assert (paper.fit.schedule, paper.fit.learning_rate) == ("plateau", 1e-3)


def test_the_kernel_of_a_small_mesh_has_one_patch() -> None:
    box = trimesh.creation.box()
    mesh = TriangleMesh.from_arrays(box.vertices, box.faces)
    x, z = interplay(mesh, 60, bilinear)
    network = fitted(mesh, KernelSettings(coefficients=3), x[:50], z[:50], 40)
    assert isinstance(network.correction, KernelCorrection)
    assert len(network.correction.anchors) == 1
    with torch.no_grad():
        missed = network.scaling.down(network(x[50:]) - z[50:] + network.scaling.mean)
    assert missed.square().mean() < 1e-3


def test_outputs_that_change_shapes_by_next_to_nothing_are_left_out(
    ball: TriangleMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, z = interplay(ball, 60, lambda a, b, f, g: a * b * f + 0.05 * a**2 * b * g)
    found = {}
    for unseen in (1e-3, 0):
        monkeypatch.setattr(kernels, "LIMITS", replace(kernels.LIMITS, unseen=unseen))
        network = fitted(ball, KernelSettings(coefficients=2), x, z, 40)
        assert isinstance(network.correction, KernelCorrection)
        with torch.no_grad():
            missed = network.coefficients(x[40:]) - network.scaling.down(z[40:])
        found[unseen] = network.correction.basis.shape[2], float(missed.square().mean())
    (rank, error), (full_rank, least) = found.values()
    assert (rank, full_rank) == (1, 2)
    assert error < least + 1e-3


@pytest.mark.parametrize(("unseen", "functions"), [(1, 5), (-1, 40)])
def test_there_are_more_functions_as_long_as_they_gain_what_can_be_seen(
    ball: TriangleMesh, monkeypatch: pytest.MonkeyPatch, unseen: float, functions: int
) -> None:
    """There are 40 samples, and at most as many functions."""
    limits = replace(kernels.LIMITS, functions=(5, 20, 80), unseen=unseen)
    monkeypatch.setattr(kernels, "LIMITS", limits)
    x, z = interplay(ball, 60, cubic)
    correction = fitted(ball, KernelSettings(coefficients=2), x, z, 40).correction
    assert isinstance(correction, KernelCorrection)
    assert correction.anchors.shape[1] == functions


def test_few_functions_have_weights_that_can_be_rounded(ball: TriangleMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """The penalty that suits held-out samples best before rounding leaves a third of the mean square after it."""
    monkeypatch.setattr(kernels, "LIMITS", replace(kernels.LIMITS, functions=(40,)))
    x, z = interplay(ball, 400, beyond_cubic)
    network = fitted(ball, KernelSettings(coefficients=3), x, z, 300)
    with torch.no_grad():
        missed = network.coefficients(x[300:]) - network.scaling.down(z[300:])
    assert missed.square().mean() < 2e-3


def test_a_kernel_looks_at_no_other_patch(ball: TriangleMesh) -> None:
    x, z = interplay(ball, 60, cubic)
    network = fitted(ball, KernelSettings(coefficients=2), x, z, 40)
    correction, y = network.correction, network.scaling.down(x)
    assert isinstance(correction, KernelCorrection)
    size = y.shape[2]
    here = correction.entries[0][correction.entries[0] < size]
    other = torch.ones(size, dtype=torch.bool)
    other[here] = False
    changed = y.clone()
    changed[:, :, here] += 0.1
    with torch.no_grad():
        moved = (correction.difference(changed) - correction.difference(y)).abs().amax(dim=0)
    assert len(correction.entries) > 1
    assert moved[other].max() == 0 < moved[here].min()


def test_a_metric_is_the_fourth_root_of_the_gradients_outer_product() -> None:
    """Here gradients are multiples of the axes, and the root of a root of their squares is left."""
    sizes = torch.tensor([1.0, 0.25, 1 / 16], dtype=torch.float64)
    metric = _updated(torch.eye(3).double(), torch.eye(3).double(), torch.zeros(2, 3).double(), torch.diag(sizes))
    torch.testing.assert_close((metric @ metric.T).diagonal(), sizes)
    assert LEARNING.power == 0.25, "found by trials: half of the consistent power"


@pytest.mark.parametrize("dropout", [0.0, 0.4])
def test_convolutions_drop_features_and_do_not_see_the_size_of_their_weights(
    ball: TriangleMesh, dropout: float
) -> None:
    torch.manual_seed(0)
    settings = ConvolutionSettings(layers=2, width=8, residual=False, dropout=dropout)
    correction = ConvolutionCorrection(settings, ball, torch.randn(len(ball.edges), 2), 2, None)
    y = torch.randn(3, 2, 2 * len(ball.edges))

    def answer(seed: int) -> torch.Tensor:
        torch.manual_seed(seed)
        with torch.no_grad():
            return correction.train()(y)

    plain = answer(1)
    assert torch.equal(plain, answer(2)) == (dropout == 0)
    with torch.no_grad():
        for convolution in correction.convolutions:
            for parameter in convolution.parameters():
                parameter.mul_(5)
    torch.testing.assert_close(answer(1), plain, rtol=1e-3, atol=1e-3)
    with torch.no_grad():
        assert torch.equal(correction.eval()(y), correction(y)), "nothing is dropped after training"


def test_a_learned_metric_finds_the_direction_that_matters() -> None:
    """One of twenty directions matters, and a quadratic in twenty variables has more coefficients than samples."""
    rng = torch.Generator().manual_seed(0)
    x, other = (torch.randn(n, 20, generator=rng, dtype=torch.float64) for n in (120, 200))
    direction = nn.functional.normalize(torch.randn(20, generator=rng, dtype=torch.float64), dim=0)
    y, wanted = ((v @ direction)[:, None] ** 2 for v in (x, other))
    metric = learned_metric(x, y, (other, wanted))
    value, vector = torch.linalg.eigh(metric @ metric.T)
    assert (vector[:, -1] @ direction).abs() > 0.999
    assert value[-1] > 20 * value[-2]


def test_a_dense_combiner_begins_as_the_affine_sum_or_as_nothing(ball: TriangleMesh) -> None:
    x, z = interplay(ball, 20, bilinear)
    residual, whole = (
        fitted(ball, DenseSettings(hidden=[4], residual=residual), x, z, 15) for residual in (True, False)
    )
    with torch.no_grad():
        sums = affine_sum(residual.scaling.mean.numpy(), x.numpy())
        np.testing.assert_allclose(residual(x).numpy(), sums, atol=2e-5)
        assert np.abs(whole(x).numpy() - sums).max() > 1e-3


@pytest.mark.parametrize("order", ["before", "after", "none"])
def test_convolutions_normalise_before_or_after_their_activation(ball: TriangleMesh, order: str) -> None:
    x, z = interplay(ball, 20, bilinear)
    torch.manual_seed(0)
    settings = PaperSettings(width=4, layers=2, normalisation=order)
    correction = fitted(ball, settings, x, z, 15).correction.train()
    assert isinstance(correction, ConvolutionCorrection)
    correction.dropout.p, seen = 0.0, []
    correction.readout.register_forward_hook(lambda layer, inputs, output: seen.append(inputs[0].flatten(0, 1)))
    correction(torch.randn(8, *x.shape[1:]))
    means, spreads = seen[0].mean(dim=0), seen[0].std(dim=0)
    assert (means.abs().max() < 1e-4) == (order == "after")
    assert (abs(spreads - 1).max() < 0.05) == (order == "after")
    assert len(correction.state_dict().keys() & {"norms.0.weight"}) == (order != "none")


def test_gaps_of_lengths_and_angles_count_and_changes_of_surfaces_do_not(ball: TriangleMesh) -> None:
    rng, rest = np.random.default_rng(0), nric(ball.vertices, ball.connectivity)
    scale = scaling(ball, noisy(ball, 30))
    tangents = NRICJacobian(ball.connectivity)(ball.vertices) @ rng.normal(size=(3 * len(ball.vertices), 10))
    gaps = SurfaceGaps(3.0, ball, scale)
    surface = scale.down(torch.from_numpy(rest + 0.01 * tangents.T).float())
    torn = torch.from_numpy(rng.normal(size=(200, len(rest)))).float()
    assert gaps(surface) < 1e-4 * surface.square().mean()
    assert float(gaps(torn) / torn.square().mean()) == pytest.approx(3, rel=0.1)
    assert not gaps.state_dict(), "no part of the model"


@pytest.mark.parametrize("kind", [DenseSettings, PaperSettings], ids=lambda kind: kind.__name__)
def test_a_combiner_is_trained_with_the_penalty(ball: TriangleMesh, kind: Any) -> None:
    x, z = interplay(ball, 20, bilinear)
    torch.manual_seed(0)
    network = fitted(ball, kind(integrability=5.0), x, z, 15)
    missed = network.coefficients(x) - network.target(z)
    penalty = SurfaceGaps(5.0, ball, network.scaling)(missed)
    assert penalty > 0.1 * missed.square().mean()
    torch.testing.assert_close(network.loss(x, network.target(z)), missed.square().mean() + penalty)
    assert network.error(network.coefficients(x), network.target(z)) == missed.square().mean(), (
        "epochs are compared without"
    )
