"""The choice between straight lines and exponentials."""

import numpy as np
import pytest

from shapespace.shell.energy import Material
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.geometry import COST, certain, cheapest, choose_geometry, hopeful
from shapespace.training.space.held_out import held_out
from tests.training.conftest import bent

AUTO = ModeSettings(geometry="auto")


def test_sums_of_displacements_are_straight_lines_of_vertices(blends):
    mesh, large = blends
    # Large displacements would turn the shapes, so that alignment adds to the directions in which they differ.
    shapes = mesh.vertices + 0.2 * (large - mesh.vertices)
    found = choose_geometry(AUTO, mesh, shapes, Material())
    assert (found.kind, found.steps, found.count) == ("vertices", 1, 3)
    assert found.errors["vertices"] <= 1.02 * min(found.errors.values())
    assert found.folded == 0
    again = held_out(mesh, shapes, np.array([0, 5]), None, AUTO, Material())
    assert (again.counts, again.steps.tolist()) == ([2, 3], [1, 1])
    away = again.distances(shapes, mesh.diagonal)
    assert away.keys() == {"modes", "components", "remembering_components", "linear_nric", "differential_coordinates"}
    assert away["modes"][1].mean() <= 1.01 * away["components"][1].mean()
    assert again.near["modes"][0] == pytest.approx(again.near["remembering_components"][0]), "as bundles remember"


def test_shapes_that_bend_are_no_straight_lines_of_vertices(ellipsoid):
    shapes = bent(ellipsoid, np.linspace(-1, 1, 8))
    found = choose_geometry(ModeSettings(geometry="auto", count=1), ellipsoid, shapes, Material())
    assert found.kind != "vertices"
    assert found.errors[found.kind] < 0.5 * found.errors["vertices"]
    few = choose_geometry(AUTO, ellipsoid, shapes[:4], Material())
    assert few.kind == "exponential"
    assert few.errors[few.kind] < 0.5 * min(error for kind, error in few.errors.items() if kind != few.kind)
    pair = choose_geometry(AUTO, ellipsoid, shapes[:2], Material())
    assert (pair.kind, pair.errors) == ("exponential", {}), "too few to tell"
    among = ("vertices", "differential")
    lines = choose_geometry(AUTO, ellipsoid, shapes[:4], Material(), among=among)
    assert (lines.kind, tuple(lines.errors)) == ("differential", among), "as four shapes choose without exponentials"
    single = [choose_geometry(AUTO, ellipsoid, shapes, Material(), among=(kind,)) for kind in ("nric", "exponential")]
    assert [(each.kind, each.errors) for each in single] == [("nric", {}), ("exponential", {})], "no choice"
    asked = choose_geometry(ModeSettings(geometry="nric", count=2), ellipsoid, shapes, Material())
    assert (asked.kind, asked.count, asked.errors) == ("nric", 2, {})
    assert choose_geometry(ModeSettings(log_steps=3), ellipsoid, shapes, Material()).steps == 3


def test_exponentials_that_reach_only_half_of_the_shapes_are_not_compared(ellipsoid):
    shapes = bent(ellipsoid, np.linspace(-1, 1, 8))
    i, j, k = ellipsoid.faces[3]
    assert "exponential" in choose_geometry(AUTO, ellipsoid, shapes, Material()).errors
    shapes[::2, i] = (shapes[::2, j] + shapes[::2, k]) / 2 + 1e-7 * np.array([0.3, 1, 0.7])  # nearly without area
    found = choose_geometry(AUTO, ellipsoid, shapes, Material())
    assert found.errors.keys() == {"vertices", "differential", "nric"}
    assert found.kind in found.errors


@pytest.mark.parametrize(
    ("errors", "folded", "chosen"),
    [
        ((1.015, 1.0, 1.0, 1.1), 0, "vertices"),
        ((1.03, 1.0, 1.03, 0.96), 0, "differential"),
        ((1.03, 1.03, 1.0, 0.96), 0, "nric"),
        ((1.03, 1.03, 1.03, 0.97), 0, "exponential"),
        ((1.0, 1.05, 1.05, 1.02), 0.5, "exponential"),
        ((1.0, 1.03, 1.05, 1.02), 0.5, "differential"),
        ((1.0, 1.05, 1.05, 1.04), 0.5, "vertices"),
        ((0.9, 1.0, 1.0, 1.0), 0.5, "vertices"),
        ((1.0, None, None, None), 0.5, "vertices"),
        ((None, None, None, 1.0), 0, "exponential"),
        ((None, None, None, None), 0, "exponential"),
    ],
)
def test_the_cheapest_map_is_chosen_that_is_as_good_as_the_others(errors, folded, chosen):
    kinds = zip(COST, errors, strict=True)
    assert cheapest({kind: error for kind, error in kinds if error is not None}, folded) == chosen


def test_maps_that_were_clearly_worse_on_all_shapes_are_not_compared_again():
    errors = {"vertices": 1.0, "differential": 1.19, "exponential": 1.3}
    assert hopeful("vertices", errors) == ("vertices", "differential")
    assert hopeful("differential", errors) == ("vertices", "differential", "exponential")
    assert hopeful("exponential", {}) == COST, "nothing was compared"


def test_folds_end_once_the_choice_is_certain(rng):
    theirs = rng.uniform(0.5, 1.5, 10)
    assert certain({"vertices": theirs, "exponential": theirs}, "vertices"), "equal, and cheaper"
    assert not certain({"vertices": theirs * rng.uniform(0.9, 1.1, 10), "exponential": theirs}, "vertices")
    assert certain({"vertices": 2 * theirs, "nric": theirs, "exponential": 1.5 * theirs}, "nric")
    near = theirs * rng.uniform(1.0, 1.06, 10)
    assert not certain({"nric": near, "exponential": theirs}, "exponential"), "too close to tell"
