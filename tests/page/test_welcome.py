"""The first seconds on the page without a code in its address."""

from tests.page.conftest import Open
from tests.page.studio import OpenPage, difference


def values(studio: OpenPage) -> list[float]:
    """The sliders' values."""
    return studio[".coordinate input[type=range]"].evaluate_all("all => all.map(({ value }) => Number(value))")


def test_the_shape_moves_by_itself_until_anything_is_touched(window: Open) -> None:
    studio = window(reduced_motion="no-preference")
    studio.page.goto(f"{studio.url}/#model=with-fine")
    studio.eventually(studio["#welcome"].is_visible)
    assert "A few numbers become a 3D shape" in studio["#welcome"].inner_text()
    assert "Parametrizing Product Shape Manifolds by Composite Networks" in studio["#welcome"].inner_text()
    studio.eventually(lambda: studio[".coordinate"].count() == 3)
    bounds = [(-0.2, 0.2), (-3.15, 3.15), (0, 1)]
    moved: set[int] = set()

    def one_after_the_other() -> bool:
        now = values(studio)
        away = {k for k, value in enumerate(now) if abs(value) > 0.02}
        assert len(away) <= 1, "more than one coordinate moves"
        assert all(low <= value <= high for value, (low, high) in zip(now, bounds, strict=True))
        moved.update(away)
        return len(moved) > 1

    studio.eventually(one_after_the_other)
    assert "z" not in studio.hash
    studio.page.keyboard.press("Shift")  # any input ends the animation
    studio.until_code([0, 0, 0])
    studio.rest()
    assert values(studio) == [0, 0, 0]
    assert studio["#undo"].is_disabled()
    still = studio.picture()
    studio.frames(20)
    assert difference(still, studio.picture()) == 0

    studio["#welcome [data-do=close]"].click()
    assert studio["#welcome"].is_hidden()
    studio.page.goto("about:blank")
    studio.page.goto(f"{studio.url}/#model=with-fine")
    studio.rest()
    assert studio["#welcome"].is_hidden()


def test_where_motion_is_not_wanted_or_a_shape_is_asked_for_nothing_moves(window: Open) -> None:
    calm = window().open()
    assert calm["#welcome"].is_visible()
    linked = window(reduced_motion="no-preference").open("#model=with-fine&z=0.1,0,0")
    assert linked["#welcome"].is_hidden()
    for studio in (calm, linked):
        studio.eventually(lambda studio=studio: studio[".end canvas.drawn"].count() == 6)
        assert {len(asked["latents"]) for asked in studio.asked if asked["mesh"] == "fine"} == {1}
