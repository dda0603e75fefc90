"""Values and colours of shapes, against closed forms."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from shapespace.files.colouring import Colouring, Quantity
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.training.collection.generators import freaky_torus
from tests.shapespace.conftest import hinge

ROTATION = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
HINGE = hinge().connectivity


def folded(angle: float, length: float = 1.0) -> np.ndarray:
    return hinge(angle, length).vertices


def between(quantity: Quantity, a: np.ndarray, b: np.ndarray, connectivity: Connectivity) -> Colouring:
    return Colouring.between(quantity, a, b, connectivity)


@pytest.mark.parametrize("quantity", [Quantity.STRETCH, Quantity.BENDING])
def test_a_rigid_motion_changes_nothing_and_is_grey(quantity: Quantity) -> None:
    torus = freaky_torus.reference()
    turned = torus.vertices @ (ROTATION * np.sign(np.linalg.det(ROTATION))).T + [1, 2, 3]
    found = between(quantity, turned, torus.vertices, torus.connectivity)
    np.testing.assert_allclose(found.values, 0, atol=1e-12)
    np.testing.assert_allclose(found.srgb, np.broadcast_to(to_rgb("#dddcdc"), (len(turned), 3)), atol=1e-9)


def test_a_spread_goes_from_blue_where_it_is_nothing_to_red() -> None:
    found = Colouring.of_spread(np.array([0, 0.003, 0.004] + 200 * [0.002]))
    assert found.ends == (0, 0.002)
    assert found.legend == {"quantity": "spread", "range": [0, 0.002], "map": "coolwarm"}
    np.testing.assert_allclose(found.srgb[[0, 1]], [to_rgb("#3b4cc0"), to_rgb("#b40426")])
    nothing = Colouring.of_spread(np.zeros(3))
    np.testing.assert_allclose(nothing.srgb, np.broadcast_to(to_rgb("#3b4cc0"), (3, 3)))


def test_a_uniform_scaling_stretches_by_its_logarithm_and_bends_nothing() -> None:
    torus = freaky_torus.reference()
    for factor in (1.5, 0.4):
        stretch = between(Quantity.STRETCH, factor * torus.vertices, torus.vertices, torus.connectivity)
        np.testing.assert_allclose(stretch.values, np.log(factor), rtol=1e-9)
        bending = between(Quantity.BENDING, factor * torus.vertices, torus.vertices, torus.connectivity)
        np.testing.assert_allclose(bending.values, 0, atol=1e-12)


def test_bending_is_the_change_of_the_angle_at_the_hinge() -> None:
    for before, after in ((0.0, 0.7), (0.3, -0.4), (-0.2, -0.9)):
        values = between(Quantity.BENDING, folded(after), folded(before), HINGE).values
        # The two tips are at no interior edge.
        np.testing.assert_allclose(values, [after - before, after - before, 0, 0], atol=1e-12)
    # Across the fold at π the change is the shorter one.
    values = between(Quantity.BENDING, folded(-3.0), folded(3.0), HINGE).values
    np.testing.assert_allclose(values[:2], 2 * np.pi - 6, atol=1e-12)


def test_long_edges_count_more() -> None:
    before, after = folded(0.0), folded(0.0, 1.2)
    values = between(Quantity.STRETCH, after, before, HINGE).values
    side, sides = np.hypot(0.5, 1), np.hypot(0.6, 1)
    expected = (np.log(1.2) + 2 * side * np.log(sides / side)) / (1 + 2 * side)
    np.testing.assert_allclose(values[:2], expected, rtol=1e-12)
    np.testing.assert_allclose(values[2:], np.log(sides / side), rtol=1e-12)


def test_faces_that_collapse_have_finite_colours() -> None:
    flat = np.zeros((4, 3))
    for quantity in Quantity:
        for a, b in ((flat, folded(0.1)), (folded(0.1), flat)):
            found = between(quantity, a, b, HINGE)
            assert np.isfinite(found.values).all()
            assert np.isfinite(found.linear).all()
            if quantity is Quantity.STRETCH:
                np.testing.assert_array_equal(found.values, 0)


def test_colours_are_those_of_the_map_that_the_legend_names() -> None:
    values = np.linspace(-1.2, 1.2, 500)
    found = Colouring(Quantity.STRETCH, values, 1.0)
    expected = mpl.colormaps[str(found.legend["map"])]((values + 1) / 2)[:, :3]
    np.testing.assert_allclose(found.srgb, expected, atol=4 / 255)
    assert np.array_equal(found.srgb[values <= -1], np.broadcast_to(found.srgb[0], (np.sum(values <= -1), 3)))


def test_linear_light_is_what_screens_show() -> None:
    found = Colouring(Quantity.STRETCH, np.linspace(-1, 1, 100), 1.0)
    shown = np.where(found.linear <= 0.0031308, 12.92 * found.linear, 1.055 * found.linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown, found.srgb, atol=1e-4)
    middle = Colouring(Quantity.STRETCH, np.zeros(1), 1.0).linear
    assert middle == pytest.approx(np.full((1, 3), 0.716), abs=0.02), (
        "linear light, not its sRGB encoding, which is 0.865"
    )


@pytest.mark.parametrize(
    ("size", "limit"), [(0.0, 0.01), (0.003, 0.01), (0.013, 0.02), (0.2, 0.2), (0.3, 0.5), (7, 10)]
)
def test_legends_end_at_round_numbers(size: float, limit: float) -> None:
    torus = freaky_torus.reference()
    scaled = np.exp(size) * torus.vertices
    found = between(Quantity.STRETCH, scaled, torus.vertices, torus.connectivity)
    assert found.limit == pytest.approx(limit)
    assert found.legend["range"] == [-found.limit, found.limit]


def test_a_stray_vertex_does_not_take_the_colour_from_the_others() -> None:
    torus = freaky_torus.reference()
    moved = 1.1 * torus.vertices
    moved[5] += 10
    found = between(Quantity.STRETCH, moved, torus.vertices, torus.connectivity)
    assert found.limit == pytest.approx(0.1)
    assert found.values.max() > 1
