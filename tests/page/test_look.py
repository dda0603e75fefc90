"""How the shape is seen: material, light, ground, turntable; and what its sliders are called."""

from typing import Any

import numpy as np
import pytest

from tests.page.conftest import Open, Visit
from tests.page.studio import OpenPage, difference, pixels


@pytest.mark.parametrize(
    "names",
    [
        ("skin", "from the side"),
        # Software takes long to draw each for the first time.
        pytest.param(("metal", "matcap", "clay", "soft", "skin", "from the side"), marks=pytest.mark.long),
    ],
    ids=["some", "all"],
)
def test_material_light_and_ground(studio: OpenPage, window: Open, names: tuple[str, ...]) -> None:
    before = studio.picture()
    studio["#to-look"].click()
    assert studio.page.get_by_label("clay").is_checked()
    assert studio["#own"].is_hidden(), "the model has no material of its own"
    for name in names:
        studio.page.get_by_label(name).check()
        before = studio.until_different(before)
    studio["#ground"].uncheck()
    studio.until_different(before, 0.001)
    studio.page.keyboard.press("Escape")
    studio["#theme"].focus()  # so that no tooltip lies over the shape
    studio.eventually(lambda: studio.hash.get("look") == "skin,side" and studio.hash.get("show") == "bare")
    other = window().open(studio.page.url.removeprefix(f"{studio.url}/"))
    assert not other["#ground"].is_checked()
    other.eventually(lambda: difference(studio.picture(), other.picture()) < 0.002)


def test_the_turntable_turns_until_the_shape_is_touched(studio: OpenPage) -> None:
    start = studio.picture()
    assert studio["#reset-view"].is_hidden(), "there is nothing to reset"
    studio["#spin"].click()
    turned = studio.until_different(start, 0.01)
    studio.until_different(turned, 0.01)
    studio["#canvas"].click(position={"x": 60, "y": 300})
    assert studio["#spin"].get_attribute("aria-pressed") == "false"
    studio.eventually(lambda: "view" in studio.hash)
    studio.frames(2)
    still = studio.picture()
    studio.frames(10)
    assert difference(still, studio.picture()) == 0
    studio["#reset-view"].click()
    studio["#theme"].focus()  # so that the canvas has no focus ring
    studio.eventually(lambda: difference(start, studio.picture()) < 0.001)


def test_the_shape_alone_fills_the_screen(studio: OpenPage) -> None:
    button = studio["#full-screen"]
    button.click()
    studio.eventually(lambda: button.get_attribute("aria-pressed") == "true")
    assert studio["header"].evaluate("e => !document.fullscreenElement.contains(e)")
    button.click()
    studio.eventually(lambda: button.get_attribute("aria-pressed") == "false")


def test_only_what_differs_from_home_can_be_reset(studio: OpenPage) -> None:
    resets = studio["[data-do=reset], #reset-all"]
    assert not any(reset.is_visible() for reset in resets.all())
    studio.slide(2, 0.5)
    assert [reset.is_visible() for reset in studio[".coordinate [data-do=reset]"].all()] == [False, False, True]
    assert studio["#reset-all"].is_visible()
    studio.coordinate(2).locator("[data-do=reset]").press("Enter")
    studio.until_code([0, 0, 0])
    assert studio.page.evaluate("document.activeElement.id") == "z2", "the focus stays in the row"


def test_the_field_of_the_seed_says_what_it_is(visit: Visit) -> None:
    studio = visit(size=(1280, 700))
    assert "Seed" in studio["#more"].inner_text()


def test_what_is_pressed_is_seen_in_forced_colours(window: Open) -> None:
    studio = window(forced_colors="active").open()
    pressed, other = (
        studio[f"#{name}"].evaluate("b => getComputedStyle(b).backgroundColor") for name in ("fine", "pull")
    )
    assert pressed != other
    picture = pixels(studio.coordinate(0).locator("input[type=range]").screenshot())
    middle = picture[len(picture) // 2]
    assert len(np.unique(middle, axis=0)) > 3, "the band, the rest of the track, and the thumb"


def test_a_shape_keeps_its_colour_while_a_slider_is_dragged(studio: OpenPage) -> None:
    def blue() -> bool:
        picture = studio.picture()
        return bool(((picture[..., 2] - picture[..., 0]) > 50).any())

    studio.eventually(lambda: studio[".factor summary canvas.drawn"].count() == 2)
    studio[".factor h2"].first.hover()
    studio.eventually(blue)
    box = studio.coordinate(0).locator("input[type=range]").bounding_box()
    assert box
    studio.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    studio.page.mouse.down()
    studio.eventually(lambda: not blue())
    studio[".factor h2"].nth(1).hover()
    studio.rest()
    assert not blue()
    studio.page.mouse.up()


def test_sliders_are_named_by_their_motion(visit: Visit) -> None:
    studio = visit("#model=figure")
    names = studio[".coordinate .name"]
    studio.eventually(lambda: "↔" in (names.nth(19).text_content() or ""), 300)
    told = names.all_text_contents()
    assert sorted(told[:2]) == ["forward ↔ back", "in ↔ out"], "the left leg"
    assert "lean right ↔ lean left" in told[12:15], "the spine"
    assert "turn left ↔ turn right" in told[17:20], "the neck"
    assert all(len(set(told[k : k + n])) == n for k, n in ((0, 2), (2, 2), (4, 3), (9, 3), (12, 3), (17, 3)))
    assert studio["#z0"].get_attribute("aria-label") == f"left hip, {told[0].replace('↔', 'to')}"
    ends = studio.coordinate(0).locator(".end")
    assert [end.get_attribute("aria-label") for end in ends.all()] == [
        f"left hip, {told[0].replace('↔', 'to')}: {end}" for end in told[0].split(" ↔ ")
    ]
    kept = studio.page.evaluate("JSON.parse(localStorage['motions:figure:4'])")
    assert [" ↔ ".join(motion) for motion in kept] == told
    studio.open("#model=with-fine")
    studio.eventually(lambda: studio[".coordinate"].count() == 3)
    assert "turn" in names.all_inner_texts(), "a word of the model's author stays"


HOME = np.random.default_rng(1).uniform(-1, 1, (400, 3)) * (0.4, 1, 0.3)
HEAD = HOME[:, 1] > 0.6
RIGHT = HOME[:, 0] < -0.25


def moved(part: np.ndarray, how: np.ndarray) -> np.ndarray:
    return HOME + np.where(part[:, None], how, 0)


@pytest.fixture(scope="module")
def shapes() -> dict[str, tuple[str, np.ndarray]]:
    """Displacements and their names, for a cloud of points with a part that moves."""
    swing = moved(RIGHT, np.broadcast_to([0, 0, 0.5], HOME.shape))
    angle = 0.3
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return {
        "a part moves up": ("down ↔ up", moved(HEAD, np.broadcast_to([0, 0.3, 0], HOME.shape))),
        "a part at the side moves out": ("in ↔ out", moved(RIGHT, np.broadcast_to([-0.3, 0, 0], HOME.shape))),
        "all turns back while a part swings": ("back ↔ forward", swing @ turn.T),
        "a part turns": ("turn left ↔ turn right", moved(HEAD, HOME @ turn.T - HOME)),
        "a part grows": ("smaller ↔ larger", moved(HEAD, 0.3 * (HOME - HOME[HEAD].mean(axis=0)))),
        "all grows taller": ("shorter ↔ taller", HOME * (1, 1.4, 1)),
    }


def test_motions_are_told_apart(studio: OpenPage, shapes: dict[str, tuple[str, np.ndarray]]) -> None:
    script = """async ([home, ends]) => {
        const { measure, motionsOf } = await import('/page/js/shape/motions.js');
        const flat = (x) => Float32Array.from(x.flat());
        const seen = ends.map((up) => measure(flat(home), flat(home), flat(up)));
        return seen.map((one) => motionsOf([{ name: 'a', start: 0, stop: 1 }], [one])[0]);
    }"""
    ends = [up.tolist() for _, up in shapes.values()]
    told: list[Any] = studio.page.evaluate(script, [HOME.tolist(), ends])
    assert {name: " ↔ ".join(motion or []) for name, motion in zip(shapes, told, strict=True)} == {
        name: expected for name, (expected, _) in shapes.items()
    }
