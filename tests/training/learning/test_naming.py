"""Names of factors and coordinates in a bundle."""

from typing import Any

import pytest
from pydantic import ValidationError

from shapespace.training.learning.naming import NamingError, bundle_names
from shapespace.training.runs.settings import ExportSettings

FACTORS = {"upper right": [0, 1], "lower left front": [2], "middle": [3]}
COORDINATES = ["upper right, 1", "upper right, 2", "lower left front", "middle"]


def settings(**given: Any) -> ExportSettings:
    return ExportSettings(name="a", title="A", description="A.", licence="MIT", **given)


def test_names_stay_where_nothing_is_said() -> None:
    assert bundle_names(FACTORS, COORDINATES, settings()) == (FACTORS, COORDINATES)


@pytest.mark.parametrize(
    ("faces", "up", "expected"),
    [
        ("+z", "+y", ["upper left", "lower right front", "middle"]),  # it looks at the viewer
        ("-z", "+y", ["upper right", "lower left back", "middle"]),  # away from the viewer
        ("+x", "+y", ["upper front", "lower back right", "middle"]),
        ("+y", "-z", ["front left", "back right lower", "middle"]),
        ("+z", "-y", ["lower right", "upper left front", "middle"]),  # head down
    ],
)
def test_left_and_right_are_the_bodys_own(faces: str, up: str, expected: list[str]) -> None:
    factors, coordinates = bundle_names(FACTORS, COORDINATES, settings(faces=faces, up=up))
    assert list(factors) == expected
    assert list(factors.values()) == list(FACTORS.values())
    assert coordinates == [f"{expected[0]}, 1", f"{expected[0]}, 2", *expected[1:]]


def test_names_win_and_coordinates_follow_their_factor() -> None:
    names = {"upper right": "left arm", "upper right, 2": "raise", "middle": "spine"}
    factors, coordinates = bundle_names(FACTORS, COORDINATES, settings(names=names, faces="+z"))
    assert list(factors) == ["left arm", "lower right front", "spine"]
    assert coordinates == ["left arm, 1", "raise", "lower right front", "spine"]


def test_names_of_a_product_are_named_too() -> None:
    found = bundle_names({"bump": [0, 1]}, ["gamma", "zeta"], settings(names={"gamma": "along", "bump": "a bump"}))
    assert found == ({"a bump": [0, 1]}, ["along", "zeta"])


def test_names_of_nothing_and_names_for_two_are_refused() -> None:
    with pytest.raises(NamingError, match="'nose', which is neither a factor nor a coordinate"):
        bundle_names(FACTORS, COORDINATES, settings(names={"nose": "a"}))
    with pytest.raises(NamingError, match="Two factors would be called 'middle'"):
        bundle_names(FACTORS, COORDINATES, settings(names={"upper right": "middle"}))
    with pytest.raises(NamingError, match="Two coordinates would be called 'b'"):
        bundle_names(FACTORS, COORDINATES, settings(names={"upper right, 1": "b", "upper right, 2": "b"}))
    with pytest.raises(ValidationError, match="cannot have its head along"):
        settings(faces="-y")
    with pytest.raises(ValidationError, match="nothing for 'middle'"):
        settings(names={"middle": " "})
