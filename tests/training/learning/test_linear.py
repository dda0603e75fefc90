"""Ridge regression and principal axes: every way to compute them agrees with the definition."""

import pytest
import torch

from shapespace.training.learning.linear import SpectralRidge, principal_axes, regression, ridge, rounded

PENALTIES = (1e-3, 1e-1, 1e1, 1e3)


def samples(n: int, p: int, q: int = 3) -> tuple[torch.Tensor, torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """Return features and noisy values of a linear map, and held-out pairs, in double precision."""
    rng = torch.Generator().manual_seed(n + p)
    x, other, true = (torch.randn(shape, generator=rng, dtype=torch.float64) for shape in ((n, p), (50, p), (p, q)))
    noise, held = (torch.randn((k, q), generator=rng, dtype=torch.float64) for k in (n, 50))
    return x, x @ true + noise, (other, other @ true + held)


def held_out_error(x: torch.Tensor, y: torch.Tensor, held_out: tuple[torch.Tensor, torch.Tensor], p: float) -> float:
    """Solve least squares of the samples together with √λ W = 0, the definition."""
    rows = torch.cat([x, p**0.5 * torch.eye(x.shape[1], dtype=x.dtype)])
    weights = torch.linalg.lstsq(rows, torch.cat([y, torch.zeros(x.shape[1], y.shape[1], dtype=x.dtype)])).solution
    return float((held_out[0] @ weights - held_out[1]).square().mean())


@pytest.mark.parametrize(("n", "p"), [(30, 12), (20, 40)])
def test_primal_dual_and_spectral_ridge_regression_are_the_same(n: int, p: int) -> None:
    x, y, held_out = samples(n, p)
    errors = {penalty: held_out_error(x, y, held_out, penalty) for penalty in PENALTIES}
    best = min(errors, key=errors.__getitem__)
    primal = ridge(x.T @ x, x.T @ y, held_out, PENALTIES)
    dual = ridge(x @ x.T, y, (held_out[0] @ x.T, held_out[1]), PENALTIES)
    spectral = SpectralRidge.fit(x.T @ x, x.T @ y, held_out, PENALTIES)
    of_samples = SpectralRidge.of_samples(x, y, held_out, PENALTIES)
    for found in (primal, dual, spectral, of_samples):
        assert found.penalty == best
        assert found.error == pytest.approx(errors[best], rel=1e-6)
    torch.testing.assert_close(x.T @ dual.weights, primal.weights)
    torch.testing.assert_close(spectral.weights, primal.weights)
    torch.testing.assert_close(of_samples.weights, primal.weights)
    for found in (spectral, of_samples):
        h, b = found.low_rank(30)
        assert h.shape == (p, 30)
        torch.testing.assert_close(h @ b, primal.weights)


def test_a_map_of_low_rank_has_the_nearest_values() -> None:
    x, y, held_out = samples(400, 12, 8)
    found = regression(x, y, held_out)
    values = x @ found.weights
    h, b = found.low_rank(8)
    torch.testing.assert_close(h @ b, found.weights)
    h, b = found.low_rank(3)
    s = torch.linalg.svdvals(values)
    lost = (values - x @ h @ b).square().sum()
    torch.testing.assert_close(lost, s[3:].square().sum(), rtol=1e-3, atol=0)


def test_ridge_regression_takes_the_penalty_that_held_out_pairs_ask_for() -> None:
    torch.manual_seed(0)
    x, other = torch.randn(30, 25), torch.randn(200, 25)
    true = torch.randn(25, 3)
    found = regression(x, x @ true, (other, other @ true))
    torch.testing.assert_close(found.weights, true.double(), atol=1e-3, rtol=0)
    found = regression(x, torch.randn(30, 3), (other, torch.zeros(200, 3)))
    assert (other.double() @ found.weights).square().mean() < 0.01, "noise is not fitted"


@pytest.mark.parametrize(("n", "p"), [(10, 30), (30, 10)])
@pytest.mark.parametrize("by", ["svd", "rows", "columns"])
def test_principal_axes_are_the_singular_vectors(by: str, n: int, p: int) -> None:
    x = samples(n, p)[0]
    s, axes = principal_axes(x, by)
    assert len(s) == len(axes) == {"svd": 10, "rows": n, "columns": p}[by]
    torch.testing.assert_close(s[:10], torch.linalg.svdvals(x))
    axes = axes[:10]
    torch.testing.assert_close(axes @ axes.T, torch.eye(10, dtype=x.dtype))
    torch.testing.assert_close((x @ axes.T).square().sum(dim=0).sqrt(), s[:10])
    assert principal_axes(x.float(), by)[1].dtype == torch.float32


def test_principal_axes_by_rows_make_no_axes_of_rounding_errors() -> None:
    x = torch.outer(torch.linspace(1, 2, 20, dtype=torch.float64), torch.linspace(-1, 3, 40, dtype=torch.float64))
    s, axes = principal_axes(x, "rows")
    assert s[0] > 0
    assert not s[1:].any()
    assert not axes[1:].any()
    assert not torch.cat([values.flatten() for values in principal_axes(0 * x, "rows")]).any()


def test_rounded_weights_make_up_for_each_other() -> None:
    """Kernels here almost depend on each other, so rounding each weight by itself would spoil the sums."""
    draw = torch.Generator().manual_seed(0)
    x, unseen = (torch.rand(n, 3, generator=draw, dtype=torch.float64) for n in (300, 500))
    kernel, values = (torch.exp(-2 * torch.cdist(u, x).square()) for u in (x, unseen))
    wanted = torch.sin(3 * x @ torch.randn(3, 5, generator=draw, dtype=torch.float64))
    weights = ridge(kernel, wanted, (kernel, wanted), [1e-6]).weights
    whole, steps, gains = rounded(weights, kernel)
    assert torch.equal(whole, whole.to(torch.int16).to(whole.dtype))
    alone = (weights / gains / steps).round() * steps * gains

    def error(rounded: torch.Tensor) -> float:
        return float((values @ (rounded - weights)).square().mean().sqrt())

    assert error(whole * steps * gains) < 2e-3
    assert error(whole * steps * gains) < 0.1 * error(alone)
