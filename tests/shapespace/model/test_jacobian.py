"""Derivatives of shapes against difference quotients of shapes solved to full accuracy."""

import numpy as np
import pytest

import shapespace
from shapespace.arrays import FloatArray
from shapespace.model.decoder import MeshChoice
from shapespace.model.network_operators import NumPyOperations


def solved(model: shapespace.ShapeModel, code: FloatArray) -> FloatArray:
    """Return the fine shape of a code in double precision throughout."""
    networks, decoder = model._network_derivatives, model.decoder
    operations = NumPyOperations()
    shapes = [
        program(code[None, factor.start : factor.stop], program.arrays, operations)
        for factor, program in networks._factors
    ]
    target = networks._combiner(np.stack(shapes, axis=1), networks._combiner.arrays, operations)[0]
    with decoder.solver() as reconstruct:
        return decoder.finish(reconstruct.from_guess(target, tolerance=1e-11).vertices, MeshChoice.FINE)


@pytest.mark.parametrize("name", ["figure", "freaky-torus"])
def test_jacobian_is_the_limit_of_difference_quotients(name: str) -> None:
    model = shapespace.load(f"models/{name}")
    code = model.sample(1, seed=2)[0].astype(float)
    found = model.jacobian(code)
    assert found.shape == (*model.vertices.shape, model.dimension)
    for k in (0, model.dimension - 1):
        step = 1e-4 * np.eye(model.dimension)[k]
        quotient = (solved(model, code + step) - solved(model, code - step)) / 2e-4
        assert np.abs(found[:, :, k] - quotient).max() < 2e-4 * np.abs(quotient).max()
