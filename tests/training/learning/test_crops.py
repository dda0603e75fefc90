"""Crops have the loss of the whole mesh on inner edges, and are drawn where the error is large."""

import numpy as np
import pytest
import torch
import trimesh

from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.combiner import CombinerNetwork
from shapespace.training.learning.combiners.convolutions import flaps
from shapespace.training.learning.combiners.correction import JointSamples
from shapespace.training.learning.combiners.crops import UNIFORM, Crops
from shapespace.training.learning.layers import Scaling
from shapespace.training.runs.network_settings import ConvolutionSettings

LAYERS = 3


@pytest.fixture(params=["closed", "open"])
def mesh(request: pytest.FixtureRequest) -> TriangleMesh:
    sphere = trimesh.creation.icosphere(2)
    faces = sphere.faces if request.param == "closed" else sphere.faces[sphere.triangles_center[:, 2] < 0.5]
    used, faces = np.unique(faces, return_inverse=True)
    return TriangleMesh.from_arrays(sphere.vertices[used], faces.reshape(-1, 3))


def crops(mesh: TriangleMesh, size: int) -> Crops:
    return Crops(mesh.edge_midpoints, flaps(mesh.connectivity), size, LAYERS)


def combiner(mesh: TriangleMesh) -> tuple[CombinerNetwork, torch.Tensor, torch.Tensor]:
    """A network that is not the affine sum, shapes of two factors as inputs, and target shapes."""
    torch.manual_seed(0)
    noise = np.random.default_rng(0).normal(size=(12, *mesh.vertices.shape))
    z = nric(mesh.vertices + 0.02 * noise, mesh.connectivity).astype(np.float32)
    settings = ConvolutionSettings(width=6, layers=LAYERS, neighbourhood="flaps")
    scaling = Scaling.of(nric(mesh.vertices, mesh.connectivity), WeightedNorm.of(mesh, 1.0).squared, z)
    inputs, joint = torch.from_numpy(z[:8].reshape(4, 2, -1)), torch.from_numpy(z[8:])
    samples = JointSamples(inputs, joint, scaling, [[0], [1]])
    network = CombinerNetwork.fit(settings, mesh, samples, samples, 0).eval()
    torch.nn.init.normal_(network.correction.readout.weight)
    return network, inputs, network.target(joint)


def test_on_inner_edges_a_crop_s_loss_is_the_whole_mesh_s(mesh: TriangleMesh) -> None:
    network, inputs, target = combiner(mesh)
    error = (network.coefficients(inputs) - target).detach().view(4, 2, -1)
    network.correction.crops = crops(mesh, 90)
    drawn = network.correction.crops.about(torch.tensor([0, 50, 100, 150]))
    assert 0 < drawn.inner.float().mean() < 1
    network.correction.crops.draw = lambda missed: drawn
    inner = torch.stack(
        [
            error[k][:, edges[inner]].square().mean()
            for k, (edges, inner) in enumerate(zip(drawn.edges, drawn.inner, strict=True))
        ]
    )
    shares = drawn.inner.sum(dim=1) / drawn.inner.sum()
    torch.testing.assert_close(network.loss(inputs, target), (inner * shares).sum())


def test_an_edge_is_inner_where_all_within_reach_is_in_the_crop(mesh: TriangleMesh) -> None:
    table, count = flaps(mesh.connectivity), mesh.connectivity.edge_count
    crop = crops(mesh, 60).about(torch.tensor([20]))
    inside = set(crop.edges[0].tolist())
    for edge, inner in zip(crop.edges[0].tolist(), crop.inner[0].tolist(), strict=True):
        reach = {edge}
        for _ in range(LAYERS):
            reach |= {other for each in reach for other in table[each].tolist() if other < count}
        assert inner == (reach <= inside)


def test_crops_lie_where_most_is_missed(mesh: TriangleMesh) -> None:
    missed = torch.full((400, mesh.connectivity.edge_count), 1e-9)
    missed[:, 33] = 1.0
    torch.manual_seed(0)
    drawn = crops(mesh, 60)
    about = drawn.about(torch.tensor([33])).edges
    hits = (drawn.draw(missed).edges == about).all(dim=1).float().mean()
    assert abs(hits - (1 - UNIFORM)) < 0.1


def test_crops_without_an_inner_edge_are_refused(mesh: TriangleMesh) -> None:
    with pytest.raises(ValueError, match="a crop of 5 edges is too small for 3 convolutions"):
        crops(mesh, 5)
