"""R² and the multilinear grid, in cases with known values."""

import hashlib
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.space import FirstStep
from shapespace.training.collection.generators.freaky_torus import FreakyTorus
from shapespace.training.learning.baselines import Exact, ExactShapes, MultilinearGrid, grid_nodes
from shapespace.training.learning.evaluation import against_limit, on_fresh_codes, r_squared, reconstruct
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.settings import EvaluationSettings
from shapespace.training.space.shell_collection import ShellCollection


@pytest.fixture(scope="module")
def torus() -> FreakyTorus:
    return FreakyTorus()


def test_r_squared_is_one_for_the_truth_zero_for_the_mean_and_weighted_between(torus: FreakyTorus) -> None:
    rng = np.random.default_rng(0)
    z = torus.shapes(torus.coordinates.uniform(12, rng)).nric
    norm = WeightedNorm.of(torus.reference, 1e-2)
    mean = np.broadcast_to(z.mean(axis=0), z.shape)
    assert r_squared(z, z, norm) == {"total": 1, "lengths": 1, "angles": 1}
    assert r_squared(mean, z, norm) == pytest.approx({"total": 0, "lengths": 0, "angles": 0})
    half = z.shape[1] // 2
    only_lengths = np.concatenate([z[:, :half], mean[:, half:]], axis=1)
    figures = r_squared(only_lengths, z, norm)
    assert figures["lengths"] == 1
    assert figures["angles"] == pytest.approx(0)
    spread = norm.squared * ((z - mean) ** 2).sum(axis=0)
    assert figures["total"] == pytest.approx(spread[:half].sum() / spread.sum())


def test_alone_keeps_one_factor_and_leaves_the_rest_at_the_reference() -> None:
    codes = np.array([[1.0, 2, 3, 4], [5, 6, 7, 8]])
    assert alone(codes, [2, 3]).tolist() == [[0, 0, 3, 4], [0, 0, 7, 8]]
    assert codes[0, 0] == 1


@pytest.mark.parametrize(("dimension", "nodes"), [(1, 16), (2, 16), (3, 10), (4, 5), (6, 3), (7, 2)])
def test_a_grid_has_no_more_nodes_than_allowed(dimension: int, nodes: int) -> None:
    settings = EvaluationSettings(grid_nodes=16)
    assert grid_nodes(dimension, settings) == nodes
    assert nodes**dimension <= settings.grid_size
    assert grid_nodes(dimension, EvaluationSettings()) == 0


def test_the_grid_is_exact_at_its_nodes_linear_between_them_and_closes_up(torus: FreakyTorus) -> None:
    grid = MultilinearGrid(torus.coordinates, [2, 3], 5, lambda codes: Exact(torus.shapes(codes).nric, None))
    step = 2 * np.pi / 5
    nodes = np.array([[1, 3], [2, 3], [4, 0], [0, 0]]) * step
    full = np.concatenate([np.zeros((4, 2)), nodes], axis=1)
    np.testing.assert_allclose(grid(full), torus.shapes(full).nric, atol=1e-6)
    between = grid(np.array([[0, 0, 1.25, 3], [0, 0, 4.5, 0]]) * step)
    values = grid(full)
    np.testing.assert_allclose(between[0], 0.75 * values[0] + 0.25 * values[1], atol=1e-6)
    np.testing.assert_allclose(between[1], 0.5 * values[2] + 0.5 * values[3], atol=1e-6)
    assert grid.size == 25 * torus.shapes(full[:1]).nric.nbytes


def test_vertex_error_of_exact_lengths_and_angles_is_nothing(torus: FreakyTorus) -> None:
    exact = torus.shapes(np.array([[1.0, 2.0, 3.0, 4.0]]))
    _, _, figures = reconstruct(torus.reference, 1e-2, exact.nric, exact.vertices)
    assert figures["max"] < 1e-6
    assert figures["status"] == {"converged": 1}
    _, _, wrong = reconstruct(torus.reference, 1e-2, 1.05 * exact.nric, exact.vertices)
    assert wrong["mean"] > 1e-3


def _exact(collection: Any) -> ExactShapes:
    def exact(name: str, codes: np.ndarray, other: Any = None) -> Exact:
        found = (other or collection).shapes(codes)
        return Exact(found.nric.astype(np.float32), found.vertices.astype(np.float32))

    return exact


def test_fresh_codes_follow_from_every_number_of_the_networks(torus: FreakyTorus) -> None:
    def fresh(*numbers: float) -> dict[str, Any]:
        parts = [nn.Linear(1, 1, bias=False) for _ in numbers]
        for part, number in zip(parts, numbers, strict=True):
            nn.init.constant_(part.weight, number)
        config = SimpleNamespace(evaluation=EvaluationSettings())
        learner = SimpleNamespace(collection=torus, config=config, main=lambda: SimpleNamespace(parts=parts))
        found = on_fresh_codes({}, learner, 3, _exact(torus))
        assert found is not None
        return found

    one = fresh(1.0, 2.0)
    assert one == fresh(1.0, 2.0)
    others = [fresh(1.0, 2.5), fresh(1.5, 2.0)]
    assert len({each["seed"] for each in (one, *others)}) == 3
    assert len({each["sha256"] for each in (one, *others)}) == 3
    expected = hashlib.sha256(np.array([1.0, 2.0], dtype=np.float32).tobytes()).hexdigest()
    assert one["seed"] == int(expected[:8], 16), "the first 32 bits of the digest"


@pytest.mark.parametrize("first_step", ["centred", "paper"])
def test_models_and_exponentials_are_compared_with_the_limit_of_many_steps(
    ellipsoid: TriangleMesh, first_step: FirstStep
) -> None:
    x = ellipsoid.vertices
    bend = without_rigid_motion(np.stack([0 * x[:, 0], 0 * x[:, 0], 0.25 * x[:, 0] ** 2], axis=1), x)
    box = {"lower": np.array([-1.0]), "upper": np.array([1.0]), "factors": {"all": [0]}, "codes": np.empty((0, 1))}
    collection = ShellCollection(
        ellipsoid, bend[None], **box, steps=4, material=Material(), scale=1.0, first_step=first_step
    )

    class Ideal(nn.Module):
        """Exponentials of the collection itself."""

        def forward(self, codes: torch.Tensor) -> torch.Tensor:
            return torch.as_tensor(collection.shapes(codes.double().numpy()).nric).float()

    config = SimpleNamespace(evaluation=EvaluationSettings(), export=SimpleNamespace(eta_reconstruction=1e-2))
    learner = SimpleNamespace(collection=collection, config=config, main=Ideal)
    found = against_limit(learner, 3, 20, _exact(collection))
    assert found is not None
    assert (found["steps"], found["codes"]) == (64, 4)
    shot, ours = found["exponentials"], found["composite"]
    assert ours["r2"]["total"] == pytest.approx(shot["r2"]["total"], abs=1e-6)
    assert ours["vertices"]["mean"] == pytest.approx(shot["vertices"]["mean"], abs=1e-4)
    missed = 1 - shot["r2"]["total"]
    assert 0 < missed < 1e-3 if first_step == "centred" else missed > 1e-3
    assert 0 < shot["vertices"]["mean"] < shot["vertices"]["max"]
    straight = replace(collection, steps=1)
    learner = SimpleNamespace(collection=straight, config=config, main=Ideal)
    assert against_limit(learner, 3, 20, _exact(straight)) is None, "one step is no geodesic"
