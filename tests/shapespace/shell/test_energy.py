import numpy as np
import pytest

from shapespace.coordinates.nric import nric
from shapespace.shell.energy import Material, ShellEnergy
from tests.shapespace.conftest import hinge

MATERIAL = Material(mu=1.3, lambda_=0.7, eta=1e-2)


@pytest.fixture
def energy(mesh):
    return ShellEnergy(mesh.connectivity, MATERIAL, mesh.area)


@pytest.fixture
def z(mesh):
    return nric(mesh.vertices, mesh.connectivity)


@pytest.fixture
def other(mesh, pose):
    return nric(pose, mesh.connectivity)


@pytest.fixture
def direction(mesh, z, rng):
    """Any change of lengths and angles, integrable or not, with zeros for the angles of boundary edges."""
    e = mesh.connectivity.edge_count
    return np.concatenate([0.1 * z[:e] * rng.standard_normal(e), mesh.connectivity.interior * rng.standard_normal(e)])


def test_nothing_is_stored_or_pulls_at_rest(energy, z):
    rest = energy.rest(z)
    assert rest.value(z) == 0
    assert not rest.gradient_deformed(z).any()
    assert not rest.gradient_rest(z).any()


def test_every_deformation_costs(energy, z, other, direction):
    assert energy.rest(z).value(other) > 0
    assert energy.rest(z).value(z + 1e-3 * direction) > 0


def test_the_empty_slots_of_boundary_angles_do_not_count(energy, mesh, z, other):
    empty = np.concatenate([np.zeros(mesh.connectivity.edge_count), ~mesh.connectivity.interior])
    rest = energy.rest(z)
    assert rest.value(other + empty) == rest.value(other)
    assert not (rest.hessian().angles * empty[mesh.connectivity.edge_count :]).any()


def test_rigid_motions_cost_nothing(energy, mesh, pose, z, other, move):
    moved = nric(move(pose), mesh.connectivity)
    assert energy.rest(z).value(moved) == pytest.approx(energy.rest(z).value(other), rel=1e-9)
    assert energy.rest(other).value(moved) < 1e-20


@pytest.mark.parametrize("s", [0.7, 0.99, 1.01, 1.5])
def test_uniform_scaling_has_the_corrected_membrane_energy(energy, mesh, z, s):
    """A = s² I. With the logarithm's factor as printed in the paper, s = 1 would not be the minimum."""
    e = mesh.connectivity.edge_count
    scaled = np.concatenate([s * z[:e], z[e:]])
    mu, lambda_ = MATERIAL.mu, MATERIAL.lambda_
    kappa = mu / 2 + lambda_ / 4
    density = mu * s**2 + lambda_ / 4 * s**4 - kappa * np.log(s**4) - mu - lambda_ / 4
    assert energy.rest(z).value(scaled) == pytest.approx(density, rel=1e-10)


def test_a_fold_of_two_triangles_has_the_bending_energy_of_its_formula():
    phi, flat = 0.3, hinge()
    energy = ShellEnergy(flat.connectivity, Material(eta=0.1), flat.area)
    z, z_folded = (nric(shape.vertices, flat.connectivity) for shape in (flat, hinge(phi)))
    # l² = 4, both areas 1, d = 2/3.
    assert energy.rest(z).value(z_folded) == pytest.approx(0.1 * phi**2 * 4 / (2 / 3))


def test_gradients_have_the_slope_of_derivatives(energy, z, other, direction, slope):
    rest = energy.rest(z)
    by_deformed = rest.gradient_deformed(other) @ direction
    by_rest = rest.gradient_rest(other) @ direction
    value = rest.value(other)
    assert slope(lambda h: rest.value(other + h * direction) - value - h * by_deformed) == pytest.approx(2, abs=0.1)
    assert slope(lambda h: energy.rest(z + h * direction).value(other) - value - h * by_rest) == pytest.approx(
        2, abs=0.1
    )


def test_the_mixed_hessian_has_the_slope_of_a_derivative(energy, z, other, direction, slope):
    rest = energy.rest(z)
    change = rest.mixed_hessian(other) @ direction
    here = rest.gradient_rest(other)
    assert slope(lambda h: rest.gradient_rest(other + h * direction) - here - h * change) == pytest.approx(2, abs=0.1)


def test_second_derivatives_have_the_slopes_of_derivatives(energy, z, other, direction, slope):
    rest = energy.rest(z)
    by_rest, by_deformed = rest.hessian_rest(other) @ direction, energy.matrix(rest.hessian_deformed(other)) @ direction
    at_rest, deformed = rest.gradient_rest(other), rest.gradient_deformed(other)
    assert slope(lambda h: energy.rest(z + h * direction).gradient_rest(other) - at_rest - h * by_rest) > 1.9
    assert slope(lambda h: rest.gradient_deformed(other + h * direction) - deformed - h * by_deformed) > 1.9


def test_the_metric_is_half_the_hessian_and_minus_the_mixed_one(energy, space, mesh, z, direction):
    h = 1e-5
    rest = energy.rest(z)
    difference = (rest.gradient_deformed(z + h * direction) - rest.gradient_deformed(z - h * direction)) / (2 * h)
    form = rest.hessian()
    e = mesh.connectivity.edge_count
    on_faces = np.einsum("ijf,jf->if", form.faces, direction[:e][energy.sides])
    hessian = np.concatenate([energy.sum_over_faces(on_faces), form.angles * direction[e:]])
    scale = np.abs(hessian).max()
    assert np.abs(hessian - difference).max() < 1e-7 * scale
    assert np.abs(hessian + rest.mixed_hessian(z) @ direction).max() < 1e-12 * scale
    # g(v, v) is the second-order part of W along v.
    v = np.random.default_rng(1).standard_normal(mesh.vertices.shape) * mesh.diagonal * 1e-6
    along = space.energy.rest(z).value(nric(mesh.vertices + v, mesh.connectivity))
    assert space.inner(mesh.vertices, v, v) == pytest.approx(along, rel=1e-2)


def test_the_unit_of_length_does_not_matter(energy, mesh, pose, z, other):
    larger = mesh.with_vertices(10 * mesh.vertices)
    energy_10 = ShellEnergy(larger.connectivity, MATERIAL, larger.area)
    value = energy_10.rest(nric(larger.vertices, larger.connectivity)).value(nric(10 * pose, larger.connectivity))
    assert value == pytest.approx(energy.rest(z).value(other), rel=1e-12)


def test_a_collapsed_face_costs_without_bound():
    """Two triangles, one of which collapses to the middle of their edge; all numbers are exact."""
    flat = hinge()
    collapsed = flat.vertices.copy()
    collapsed[2] = [1, 0, 0]
    rest = ShellEnergy(flat.connectivity, MATERIAL, flat.area).rest(nric(flat.vertices, flat.connectivity))
    assert rest.value(nric(collapsed, flat.connectivity)) == np.inf


def test_many_shapes_at_once_are_the_same_as_one_by_one(energy, z, other):
    both = energy.rest(np.stack([z, other]))
    against = np.stack([other, z])
    for i, (rest, deformed) in enumerate(zip((z, other), (other, z), strict=True)):
        one = energy.rest(rest)
        assert both.value(against)[i] == pytest.approx(one.value(deformed))
        np.testing.assert_allclose(both.gradient_rest(against)[i], one.gradient_rest(deformed), atol=1e-13)
        np.testing.assert_allclose(both.gradient_deformed(against)[i], one.gradient_deformed(deformed), atol=1e-13)
        np.testing.assert_allclose(both.hessian().faces[i], one.hessian().faces)


@pytest.mark.parametrize("wrong", [{"mu": 0}, {"lambda_": -1}, {"eta": 0}, {"eta": np.nan}, {"mu": np.inf}])
def test_an_impossible_material_is_refused(wrong):
    with pytest.raises(ValueError, match="material"):
        Material(**wrong)
