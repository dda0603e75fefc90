"""Laws of the networks: what they are at the start, what they can't see, and gradients made by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from torch import nn

from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.training.learning.corrections import ridge_regression
from shapespace.training.learning.layers import (
    EdgeConvolution,
    Flaps,
    FourierProducts,
    LatentFeatures,
    PatchBasis,
    Polynomials,
    Star,
    flaps,
    narrowest,
)
from shapespace.training.learning.networks import CombinerNetwork, FactorNetwork, Scaling, affine_sum
from shapespace.training.learning.polynomials import PatchPolynomials, learned_metric
from shapespace.training.runs.config import CombinerSettings, LatentNetworkSettings
from shapespace.training.runs.coordinates import Coordinates

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


def star(connectivity: Connectivity) -> np.ndarray:
    """(E, E) which edges share a vertex, the edge itself left out."""
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


def test_a_residual_combiner_begins_as_the_affine_sum(ball: TriangleMesh) -> None:
    z = noisy(ball, 6).astype(np.float32)
    factors = z.reshape(2, 3, -1)
    network = CombinerNetwork(CombinerSettings(width=4), ball.connectivity, scaling(ball, z), 3).eval()
    with torch.no_grad():
        answer = network(torch.from_numpy(factors)).numpy()
    reference = nric(ball.vertices, ball.connectivity)
    np.testing.assert_allclose(answer, affine_sum(reference, factors), atol=2e-5)


Missed = Callable[[NDArray, NDArray, NDArray, NDArray], NDArray]


def interplay(ball: TriangleMesh, count: int, missed: Missed) -> tuple[torch.Tensor, torch.Tensor]:
    """Shapes z̄ + a d and z̄ + b e of two factors, and joint ones that miss their sum by ``missed(a, b, f, g)``."""
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


def test_pairwise_products_find_a_bilinear_interplay(ball: TriangleMesh) -> None:
    """a b f is out of reach of the affine sum and exact with one product."""
    x, y = interplay(ball, 60, lambda a, b, f, g: a * b * f)
    network = CombinerNetwork(
        CombinerSettings(width=4, pairwise=1), ball.connectivity, scaling(ball, y.numpy()), 2
    ).eval()  # fmt: skip
    with torch.no_grad():
        before = (network(x) - y).abs().max()
        network.fit_pairwise(x[:40], y[:40], (x[40:], y[40:]))
        after = (network(x) - y).abs().max()
    assert before > 0.01
    assert after < 1e-4


@pytest.mark.parametrize(
    ("settings", "missed", "left"),
    [
        (CombinerSettings(kernel=3), beyond_cubic, 1e-2),
        (CombinerSettings(kernel=0, polynomial=3, monomials=20), cubic, 1e-3),
    ],
    ids=["kernel", "polynomials"],
)
def test_corrections_find_an_interplay_from_factors_alone(
    ball: TriangleMesh, settings: CombinerSettings, missed: Missed, left: float
) -> None:
    """At codes they have not seen; and they come back from a saved state as they were."""
    x, y = interplay(ball, 260, missed)
    scale = scaling(ball, y.numpy())
    network = CombinerNetwork(settings, ball.connectivity, scale, 2).eval()
    unseen = slice(180, None)
    with torch.no_grad():
        before = (network(x[unseen]) - y[unseen]).square().mean()
        network.fit_correction(settings, ball.edge_midpoints, (x[:150], y[:150]), (x[150:180], y[150:180]), 0)
        after = (network(x[unseen]) - y[unseen]).square().mean()
        assert after < left * before
        again = CombinerNetwork(settings, ball.connectivity, scale, 2).eval()
        again.load_state_dict(network.state_dict())
        torch.testing.assert_close(again(x), network(x))


def test_polynomials_look_at_no_other_patch(ball: TriangleMesh) -> None:
    x, z = interplay(ball, 60, cubic)
    y = x - x.mean(dim=0)
    fitted = PatchPolynomials.fit(2, 10, ball.edge_midpoints, (y[:40], z[:40]), (y[40:], z[40:]), 0)
    here = fitted.entries[0][fitted.entries[0] < z.shape[1]]
    other = torch.ones(z.shape[1], dtype=torch.bool)
    other[here] = False
    changed = y[40:].clone()
    changed[:, :, here] += 0.1
    with torch.no_grad():
        moved = (fitted(changed) - fitted(y[40:])).abs().amax(dim=0)
    assert len(fitted.entries) > 1
    assert moved[other].max() == 0 < moved[here].min()


def test_a_learned_metric_finds_the_direction_that_matters() -> None:
    """Of twenty, from samples too few to tell a quadratic in twenty variables."""
    rng = torch.Generator().manual_seed(0)
    x, other = (torch.randn(n, 20, generator=rng, dtype=torch.float64) for n in (120, 200))
    direction = nn.functional.normalize(torch.randn(20, generator=rng, dtype=torch.float64), dim=0)
    y, wanted = ((v @ direction)[:, None] ** 2 for v in (x, other))
    metric, _ = learned_metric(x, y, (other, wanted))
    value, vector = torch.linalg.eigh(metric @ metric.T)
    assert (vector[:, -1] @ direction).abs() > 0.999
    assert value[-1] > 20 * value[-2]


def test_weights_of_polynomials_take_a_byte_each(ball: TriangleMesh) -> None:
    x, z = interplay(ball, 60, cubic)
    y = x - x.mean(dim=0)
    fitted = PatchPolynomials.fit(3, 60, ball.edge_midpoints, (y[:40], z[:40]), (y[40:], z[40:]), 0)
    assert narrowest(fitted.weights) == torch.int8
    assert narrowest(fitted.axes) == narrowest(fitted.basis) == torch.int8


def test_ridge_regression_takes_a_penalty_that_held_out_pairs_ask_for() -> None:
    torch.manual_seed(0)
    x, other = torch.randn(30, 25), torch.randn(200, 25)
    true = torch.randn(25, 3)
    h, b = ridge_regression(x, x @ true, (other, other @ true))
    torch.testing.assert_close(h @ b, true.double(), atol=1e-3, rtol=0)
    h, b = ridge_regression(x, torch.randn(30, 3), (other, torch.zeros(200, 3)))
    assert (other.double() @ h @ b).square().mean() < 0.01, "noise is not followed"


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
    # Orthonormal but for the rounding to 16 bits.
    torch.testing.assert_close(basis.encode(kept), basis.encode(x), atol=1e-3, rtol=1e-3)


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
    assert torch.linalg.matrix_rank(values) == products.size, "no wave twice"
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
