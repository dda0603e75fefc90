"""Laws of the networks: initial values, invariances, closed-form fits, and gradients coded by hand."""

import numpy as np
import pytest
import torch

from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm, nric
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.baselines import LatentKernel
from shapespace.training.learning.latent_features import FourierProducts, LatentFeatures, Polynomials, affordable_degree
from shapespace.training.learning.layers import PatchBasis, Scaling, perceptron
from shapespace.training.learning.networks import FactorNetwork
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.network_settings import LatentNetworkSettings
from tests.training.learning.conftest import noisy, scaling

TORUS = Coordinates(np.zeros(2), np.full(2, 2 * np.pi), np.full(2, 2 * np.pi))


def test_a_factor_of_many_coordinates_takes_polynomials_of_a_lower_degree() -> None:
    degrees = [affordable_degree(3, m) for m in (12, 40, 47, 48, 80, 500)]
    assert degrees == [3, 3, 3, 2, 2, 1]
    coordinates = Coordinates(-np.ones(80), np.ones(80), np.full(80, np.nan))
    network = FactorNetwork(LatentNetworkSettings(hidden=[4]), coordinates, Scaling.blank(6), None)
    assert network.skip.shape == (1 + 80 + 80 * 81 // 2, 6)


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
    """Values are noisy, derivatives are exact."""
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


def test_scaled_differences_are_in_a_given_norm(sheet: TriangleMesh) -> None:
    z, norm = noisy(sheet, 50), WeightedNorm.of(sheet, 0.03)
    rest, weights = nric(sheet.vertices, sheet.connectivity), WeightedNorm.of(sheet, 1.0).squared
    y = Scaling.of(rest, weights, z, eta=0.03).down(torch.from_numpy(z).float()).double().numpy()
    assert np.square(y - y.mean(axis=0)).mean() == pytest.approx(1, rel=1e-4)
    sizes, wanted = (y**2).sum(axis=1), (z - rest) ** 2 @ norm.squared
    np.testing.assert_allclose(sizes / sizes[0], wanted / wanted[0], rtol=1e-4)


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


def test_a_hidden_layer_normalises_before_or_after_its_activation() -> None:
    torch.manual_seed(0)
    x = torch.randn(200, 3)
    after, before, plain = (perceptron([3, 5, 2], order)[:-1](x).detach() for order in ("after", "before", "none"))
    assert after.mean(dim=0).abs().max() < 1e-5
    torch.testing.assert_close(after.std(dim=0), torch.ones(5), atol=0.05, rtol=0)
    assert before.mean(dim=0).min() > 0.05, "ELU raises the mean of normalised values"
    assert not any(isinstance(layer, torch.nn.BatchNorm1d) for layer in perceptron([3, 5, 2], "none"))
    assert plain.std(dim=0).max() < 0.9
    assert sum(isinstance(layer, torch.nn.Dropout) for layer in perceptron([3, 5, 4, 2], "after", 0.1)) == 2
