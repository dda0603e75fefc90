"""Laws of the networks: initial values, invariances, closed-form fits, and gradients coded by hand."""

from __future__ import annotations

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
from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm, nric
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.training.learning.baselines import LatentKernel
from shapespace.training.learning.combiners import kernels
from shapespace.training.learning.combiners.combiner import CORRECTIONS, CombinerNetwork, choices
from shapespace.training.learning.combiners.convolutions import EdgeConvolution, Flaps, Star, flaps
from shapespace.training.learning.combiners.correction import JointSamples, Slopes
from shapespace.training.learning.combiners.kernels import KernelCorrection
from shapespace.training.learning.combiners.metric import learned_metric
from shapespace.training.learning.composite import affine_sum
from shapespace.training.learning.export import to_onnx
from shapespace.training.learning.fitting import read_network, save_network
from shapespace.training.learning.latent_features import FourierProducts, LatentFeatures, Polynomials, affordable_degree
from shapespace.training.learning.layers import PatchBasis, Scaling
from shapespace.training.learning.networks import FactorNetwork
from shapespace.training.runs.config import (
    AutoSettings,
    ConvolutionSettings,
    FieldSettings,
    KernelSettings,
    LatentNetworkSettings,
    PaperSettings,
    ProductSettings,
)
from shapespace.training.runs.latent_coordinates import Coordinates

AROUND = {"star": Star, "flaps": Flaps}
TORUS = Coordinates(np.zeros(2), np.full(2, 2 * np.pi), np.full(2, 2 * np.pi))


@pytest.fixture
def ball() -> TriangleMesh:
    sphere = trimesh.creation.icosphere(2)
    return TriangleMesh.from_arrays(sphere.vertices, sphere.faces)


@pytest.fixture
def sheet() -> TriangleMesh:
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    quads = [(i + 5 * j, i + 1 + 5 * j, i + 6 + 5 * j, i + 5 + 5 * j) for i in range(4) for j in range(3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return TriangleMesh.from_arrays(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), faces)


def scaling(mesh: TriangleMesh, samples: np.ndarray) -> Scaling:
    return Scaling.of(nric(mesh.vertices, mesh.connectivity), WeightedNorm.of(mesh, 1.0).squared, samples)


def noisy(mesh: TriangleMesh, count: int, size: float = 0.05) -> np.ndarray:
    rng = np.random.default_rng(3)
    return nric(mesh.vertices + size * rng.normal(size=(count, *mesh.vertices.shape)), mesh.connectivity)


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


def test_a_factor_of_many_coordinates_takes_polynomials_of_a_lower_degree() -> None:
    degrees = [affordable_degree(3, m) for m in (12, 40, 47, 48, 80, 500)]
    assert degrees == [3, 3, 3, 2, 2, 1]
    coordinates = Coordinates(-np.ones(80), np.ones(80), np.full(80, np.nan))
    network = FactorNetwork(LatentNetworkSettings(hidden=[4]), coordinates, Scaling.blank(6), None)
    assert network.skip.shape == (1 + 80 + 80 * 81 // 2, 6)


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
    """A combiner fitted in closed form to the first ``own`` samples; the others select its settings."""
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
    """Shapes z̄ + a d and z̄ + b e of two factors, and joint ones, their sum plus ``missed(a, b, f, g)``."""
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
    """On new codes its squared error is less than ``left`` times that of the affine sum."""
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
    assert list(network.tried) == tried


def test_derivatives_teach_a_correction(ball: TriangleMesh) -> None:
    """With those at 12 of 15 samples it errs less than without, and with wrong ones more."""
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
    "settings", [settings for settings, _, _ in KINDS] + [PaperSettings(width=4), AutoSettings()], ids=lambda s: s.kind
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


def test_every_kind_has_a_class() -> None:
    assert {settings.kind for settings, _, _ in KINDS} | {FieldSettings().kind} == set(CORRECTIONS)
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
    """Of 40 samples, whose number is the most that there can be."""
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


def test_auto_is_the_kernel_where_nothing_wanders(ball: TriangleMesh) -> None:
    x, z = interplay(ball, 60, cubic)
    network = fitted(ball, AutoSettings(), x, z, 40)
    assert network.settings.kind == "kernel"
    wanted = network.scaling.down(z[40:])
    with torch.no_grad():
        error = float((network.coefficients(x[40:]) - wanted).square().mean())
    assert network.tried == {"kernel": pytest.approx(error, rel=1e-3)}
    assert CombinerNetwork.load(network.metadata, ball, network.state_dict()).tried == network.tried


def test_kernel_regression_on_codes_finds_a_smooth_map(ball: TriangleMesh) -> None:
    """A map of an angle and a bounded coordinate; fitted to noisy values, its error is below the noise."""
    coordinates = Coordinates(np.array([0.0, -3.0]), np.array([2 * np.pi, 5.0]), np.array([2 * np.pi, np.nan]))
    codes = torch.as_tensor(coordinates.uniform(300, np.random.default_rng(0)), dtype=torch.float32)
    rng = np.random.default_rng(1)
    maps = torch.as_tensor(rng.standard_normal((3, 2 * len(ball.connectivity.edges))), dtype=torch.float32)
    a, b = codes.T
    z = torch.stack([torch.cos(2 * a), torch.sin(a) * b, torch.exp(b / 5)], dim=1) @ maps
    own, held_out, unseen = ((codes[part], z[part]) for part in (slice(150), slice(150, 200), slice(200, None)))
    scaling = Scaling.of(np.zeros(z.shape[1]), np.ones(z.shape[1]), own[1].numpy())
    network = LatentKernel(coordinates, scaling, own, held_out)
    spread = (unseen[1] - unseen[1].mean(dim=0)).square().mean()
    assert (network(unseen[0]) - unseen[1]).square().mean() < 1e-3 * spread
    turned = unseen[0] + torch.tensor([2 * np.pi, 0.0])
    assert torch.allclose(network(turned), network(unseen[0]), atol=1e-3)
    noise = 0.3 * torch.randn(own[1].shape, generator=torch.Generator().manual_seed(0)) * spread.sqrt()
    rough = LatentKernel(coordinates, scaling, (own[0], own[1] + noise), held_out)
    assert (rough(unseen[0]) - unseen[1]).square().mean() < 0.5 * noise.square().mean()


def test_derivatives_teach_kernel_regression_on_codes(ball: TriangleMesh) -> None:
    """From noisy values and the derivatives of what is behind the noise."""
    coordinates = Coordinates(np.array([-1.0, -3.0]), np.array([1.0, 5.0]), np.full(2, np.nan))
    codes = torch.as_tensor(coordinates.uniform(120, np.random.default_rng(0)), dtype=torch.float32)
    rng = np.random.default_rng(1)
    maps = torch.as_tensor(rng.standard_normal((3, 2 * len(ball.connectivity.edges))), dtype=torch.float32)

    def shapes(codes: torch.Tensor) -> torch.Tensor:
        a, b = codes.T
        return torch.stack([torch.cos(2 * a), torch.sin(a) * b, torch.exp(b / 5)], dim=1) @ maps

    z, some = shapes(codes), codes[:24]
    held_out, unseen = ((codes[part], z[part]) for part in (slice(24, 60), slice(60, None)))
    own = some, z[:24] + 0.3 * z.std() * torch.randn(24, z.shape[1], generator=torch.Generator().manual_seed(0))
    along = [torch.autograd.functional.jvp(shapes, some, unit.expand_as(some))[1] for unit in torch.eye(2)]
    derivatives = torch.stack(along, dim=1)
    scale = Scaling.of(np.zeros(z.shape[1]), np.ones(z.shape[1]), z.numpy())

    def error(slopes: tuple[torch.Tensor, torch.Tensor] | None) -> float:
        network = LatentKernel(coordinates, scale, own, held_out, slopes)
        return float((network(unseen[0]) - unseen[1]).square().mean())

    assert error((some, derivatives)) < 0.3 * error(None)
    assert error((some, -derivatives)) > error(None)


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


def test_a_learned_metric_finds_the_direction_that_matters() -> None:
    """One of twenty directions, from fewer samples than a quadratic in twenty variables has coefficients."""
    rng = torch.Generator().manual_seed(0)
    x, other = (torch.randn(n, 20, generator=rng, dtype=torch.float64) for n in (120, 200))
    direction = nn.functional.normalize(torch.randn(20, generator=rng, dtype=torch.float64), dim=0)
    y, wanted = ((v @ direction)[:, None] ** 2 for v in (x, other))
    metric = learned_metric(x, y, (other, wanted))
    value, vector = torch.linalg.eigh(metric @ metric.T)
    assert (vector[:, -1] @ direction).abs() > 0.999
    assert value[-1] > 20 * value[-2]


def test_scaled_differences_go_both_ways_and_have_unit_size(sheet: TriangleMesh) -> None:
    z = noisy(sheet, 50)
    network = scaling(sheet, z)
    y = network.down(torch.from_numpy(z).float())
    half = y.shape[1] // 2
    spread = (y - y.mean(dim=0)).square()
    assert spread[:, :half].mean() == pytest.approx(1, rel=1e-4)
    assert spread[:, half:].mean() == pytest.approx(1, rel=1e-4)
    inner = np.concatenate([np.ones(half, bool), sheet.connectivity.interior])
    np.testing.assert_allclose(network.up(y)[:, inner], z[:, inner], atol=1e-5)
    assert np.all(network.up(y + 1)[:, ~inner].numpy() == 0), "a boundary edge has no angle"


@pytest.mark.parametrize("patches", [1, 5])
def test_a_patch_basis_keeps_the_variance_it_promises(ball: TriangleMesh, patches: int) -> None:
    y = noisy(ball, 40).astype(np.float32)
    for energy in (0.6, 0.95):
        basis = PatchBasis.fit(y, ball.edge_midpoints, patches, energy, seed=0)
        x = torch.from_numpy(y)
        kept = basis(basis.encode(x))
        lost = ((x - kept).square().sum() / (x - x.mean(dim=0)).square().sum()).item()
        assert 0 < lost <= 1 - energy + 1e-5
    # Orthonormal up to rounding to 16 bits.
    torch.testing.assert_close(basis.encode(kept), basis.encode(x), atol=1e-3, rtol=1e-3)


def test_a_sparse_basis_has_entries_for_the_edges_that_vary(ball: TriangleMesh) -> None:
    """A hundred edges have nearly all of the variance; the others keep their mean, in patches where none varies too."""
    moving = np.argsort(ball.edge_midpoints[:, 0])[-100:]
    spread = np.full(len(ball.edge_midpoints), 1e-3)
    spread[moving] = 1
    y = (1 + np.tile(spread, 2) * np.random.default_rng(0).normal(size=(400, 2 * len(spread)))).astype(np.float32)
    for patches in (1, 5):
        basis = PatchBasis.fit(y, ball.edge_midpoints, patches, 0.9999, seed=0, support=0.999)
        x, edges = torch.from_numpy(y), len(spread)
        kept = basis(basis.encode(x))
        constant = (kept == basis.mean).all(dim=0)
        assert set(np.flatnonzero(~constant)) == {*moving, *(edges + moving)}
        assert (x - kept).square().sum() < 0.003 * (x - x.mean(dim=0)).square().sum()
        again = PatchBasis.blank(basis.state_dict())
        again.load_state_dict(basis.state_dict())
        assert torch.equal(again(basis.encode(x)), kept)
        assert torch.equal(torch.export.export(basis, (basis.encode(x),)).module()(basis.encode(x)), kept)


def test_what_no_surface_does_counts_more(ball: TriangleMesh) -> None:
    """Errors along changes of lengths and angles of surfaces count as before, others with the weight."""
    connectivity, rng = ball.connectivity, np.random.default_rng(0)
    rest = nric(ball.vertices, connectivity)
    tangents = NRICJacobian(connectivity)(ball.vertices) @ rng.normal(size=(3 * len(ball.vertices), 20))
    change = 0.01 * np.concatenate([tangents.T, rng.normal(size=(60, len(rest)))])
    scale = scaling(ball, rest + change)
    y = scale.down(torch.from_numpy(rest + change).float())
    basis = PatchBasis.fit(torch.cat([y, -y]).numpy(), ball.edge_midpoints, 1, 0.999999, 0)
    network = FactorNetwork(LatentNetworkSettings(hidden=[4]), TORUS, scale, basis)
    missed = basis.encode(y)
    before = network.error(missed, 0 * missed)
    network.penalise(basis, Integrability(connectivity).jacobian(rest), 5)
    counts = [float(network.error(row, 0 * row) / row.square().mean()) for row in missed]
    np.testing.assert_allclose(counts[:20], 1, atol=0.01)
    assert min(counts[20:]) > 2
    assert network.error(missed, 0 * missed) > before == missed.square().mean()


def test_periodic_features_close_up_and_bounded_ones_fill_the_unit_interval() -> None:
    mixed = Coordinates(np.array([0.0, -3.0]), np.array([2 * np.pi, 5.0]), np.array([2 * np.pi, np.nan]))
    features = LatentFeatures(mixed, order=3)
    assert features.size == 7
    low, high = features(torch.tensor([[0.0, -3.0], [2 * np.pi, 5.0]]))
    torch.testing.assert_close(low[1:], high[1:], atol=1e-5, rtol=0)
    assert (low[0], high[0]) == (-1, 1)


def test_fourier_products_hold_each_wave_of_the_ellipse_once() -> None:
    products = FourierProducts(TORUS, [3, 2])
    x = torch.rand(400, 2) * 2 * np.pi
    values = products(x).double()
    assert torch.linalg.matrix_rank(values) == products.size, "no product occurs twice"
    for wave in (torch.cos(3 * x[:, 0]), torch.sin(2 * x[:, 1]), torch.sin(2 * x[:, 0]) * torch.cos(x[:, 1])):
        solution = torch.linalg.lstsq(values, wave.double()[:, None]).solution
        torch.testing.assert_close(values @ solution, wave.double()[:, None], atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match="one order for each coordinate"):
        FourierProducts(TORUS, [3])


def test_polynomials_hold_each_monomial_once_and_are_orthogonal_over_the_box() -> None:
    box = Coordinates(np.array([-1.0, 0.0]), np.array([3.0, 0.5]), np.full(2, np.nan))
    products = Polynomials(box, 3)
    assert products.size == 10
    nodes, weights = np.polynomial.legendre.leggauss(5)
    x = torch.from_numpy(np.stack(np.meshgrid(1 + 2 * nodes, 0.25 + 0.25 * nodes), -1).reshape(-1, 2)).float()
    w = torch.from_numpy(np.outer(weights, weights).ravel() / 4)
    values = products(x).double()
    sizes = 0.3 ** torch.tensor([0, 1, 1, 2, 2, 2, 3, 3, 3, 3]).double()
    torch.testing.assert_close(values.T @ (w[:, None] * values), torch.diag(sizes**2), atol=1e-5, rtol=0)
    for monomial in (x[:, 0] ** 3, x[:, 0] * x[:, 1] ** 2, x[:, 1]):
        solution = torch.linalg.lstsq(values, monomial.double()[:, None]).solution
        torch.testing.assert_close(values @ solution, monomial.double()[:, None], atol=1e-4, rtol=0)


def test_the_fitted_skip_layer_reproduces_a_trigonometric_polynomial(ball: TriangleMesh) -> None:
    rng = np.random.default_rng(1)
    a = rng.uniform(0, 2 * np.pi, (300, 2))
    reference = nric(ball.vertices, ball.connectivity)
    u, v = 0.01 * rng.normal(size=(2, len(reference)))
    z = reference + np.cos(2 * a[:, :1]) * u + np.sin(a[:, :1]) * np.cos(a[:, 1:]) * v
    settings = LatentNetworkSettings(hidden=[4], skip_orders=[3, 3])
    network = FactorNetwork(settings, TORUS, scaling(ball, z), None).eval()
    latent, target = torch.from_numpy(a).float(), torch.from_numpy(z).float()
    with torch.no_grad():
        network.fit_skip(latent, network.target(target), (latent[:50], network.target(target[:50])))
        assert (network(latent) - target).abs().max() < 1e-4
