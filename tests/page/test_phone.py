"""The page on a phone, upright and on its side, and in a window at 200 % zoom."""

import pytest

from tests.page.conftest import Open, Visit
from tests.page.studio import OpenPage

#: How many sliders can be seen and touched.
SLIDERS = """all => all.filter((slider) => {
    const { left, right, top, bottom } = slider.getBoundingClientRect();
    const isInside = left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight;
    return isInside && document.elementFromPoint((left + right) / 2, (top + bottom) / 2) === slider;
}).length"""


#: Whether the longest name of the bundled models fits the menu.
WHOLE = """menu => {
    const copy = menu.cloneNode();
    copy.append(new Option('Freaky Torus'));
    Object.assign(copy.style, { position: 'absolute', width: 'max-content' });
    menu.after(copy);
    const wide = copy.offsetWidth;
    copy.remove();
    return wide <= menu.offsetWidth;
}"""


def sliders(studio: OpenPage) -> int:
    return int(studio[".coordinate input[type=range]"].evaluate_all(SLIDERS))


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390), pytest.param(640, 400, marks=pytest.mark.long)])
def test_three_sliders_stand_beside_the_shape(window: Open, width: int, height: int) -> None:
    options = {"viewport": {"width": width, "height": height}, "has_touch": True, "is_mobile": width != 640}
    studio = window(**options).open("#model=figure")
    for model in ("figure", "with-fine"):
        if model != "figure":
            studio.open(f"#model={model}")
            studio.eventually(lambda: studio[".coordinate"].count() == 3)
        studio.eventually(lambda: sliders(studio) >= 3)
        assert studio["#welcome"].is_visible() == (model == "figure")
        if model == "figure":
            studio["#welcome [data-do=close]"].click()
            studio.eventually(lambda: sliders(studio) >= 3)
        assert studio.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert studio["#model"].evaluate(WHOLE), "the model's name is not cut"
    header = studio["header"].bounding_box()
    assert header
    assert header["height"] < 60, "the header has one row"
    row = studio.coordinate(0)
    outer = row.bounding_box()
    for part in (".name", "input[type=number]", "input[type=range]", "[data-do=lock]"):
        inner = row.locator(part).bounding_box()
        assert outer
        assert inner
        assert outer["y"] <= inner["y"] + 1
        assert inner["y"] + inner["height"] <= outer["y"] + outer["height"] + 1
    assert outer is not None
    assert outer["height"] < 64
    studio["#to-more"].click()
    for name in ("#seed", "#theme", "#about"):
        assert studio[name].is_visible()
    studio["#about"].click()
    studio.eventually(studio["#card"].is_visible)
    studio.page.keyboard.press("Escape")
    studio["#to-look"].click()
    tools, menu = studio[".tools"].bounding_box(), studio["#look"].bounding_box()
    assert tools
    assert menu
    assert tools["y"] + tools["height"] <= menu["y"], "the menu covers no buttons"
    assert menu["y"] + menu["height"] <= height


def test_tables_and_fields_fit_the_dialogs_of_a_phone(visit: Visit) -> None:
    studio = visit("#model=figure", size=(390, 844))
    studio["#to-more"].click()
    for button, dialog in (("#about", "#card"), ("#name", "#names")):
        studio[button].click()
        studio.eventually(studio[dialog].is_visible)
        assert studio[dialog].evaluate("e => e.scrollWidth <= e.clientWidth"), dialog
        studio.page.keyboard.press("Escape")


def test_the_legend_does_not_hide_the_head_in_a_narrow_window(visit: Visit) -> None:
    studio = visit("#model=figure&colour=stretch", size=(900, 700))
    studio.eventually(studio["#legend"].is_visible)
    stage, legend = studio[".stage"].bounding_box(), studio["#legend"].bounding_box()
    assert stage
    assert legend
    assert legend["y"] > stage["y"] + 0.8 * stage["height"]


@pytest.mark.parametrize("size", [(1200, 700), (390, 844), (844, 390)])
def test_a_message_leaves_the_sliders_free_and_is_not_there_twice(visit: Visit, size: tuple[int, int]) -> None:
    studio = visit(size=size, complains=True)
    studio.page.route("**/sample*", lambda route: route.abort())
    for _ in range(2):
        studio["#random"].click()
        studio.eventually(lambda: "does not answer" in studio.messages)
    script = "async () => { const { say } = await import('/page/js/messages.js'); say('A fault', { kind: 'error' }); }"
    for _ in range(2):
        studio.page.evaluate(script)
    assert studio["#messages .message:visible"].count() == 2
    message, panel = studio["#messages"].bounding_box(), studio[".panel"].bounding_box()
    assert message
    assert panel
    assert message["x"] + message["width"] <= panel["x"] or message["y"] + message["height"] <= panel["y"]


def test_a_legend_below_the_shape_leaves_the_buttons_in_one_row(visit: Visit) -> None:
    studio = visit("#model=with-fine&z=0.1,1,0.5&colour=stretch", size=(844, 390))
    studio.eventually(studio["#legend"].is_visible)
    tops = studio[".tools button:visible"].evaluate_all("all => all.map((b) => b.getBoundingClientRect().top)")
    assert max(tops) - min(tops) < 10


def test_the_sheet_is_dragged_pressed_and_moved_by_keys(visit: Visit) -> None:
    studio = visit(size=(390, 844))
    handle = studio["#sheet"]

    def drag(by: float) -> tuple[float, str | None]:
        box = handle.bounding_box()
        assert box
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        studio.page.mouse.move(x, y)
        studio.page.mouse.down()
        studio.page.mouse.move(x, y + by, steps=3)
        studio.page.mouse.up()
        panel = studio[".panel"].bounding_box()
        assert panel
        return panel["height"], handle.get_attribute("aria-valuenow")

    middle = studio[".panel"].bounding_box()
    assert middle
    most, share = drag(-250)
    assert (most > 1.5 * middle["height"], share) == (True, "80")
    least, share = drag(700)
    assert (least < 100, share) == (True, "0")
    assert studio["#to-files"].is_visible()
    assert drag(0)[0] == pytest.approx(middle["height"]), "a press opens it"
    handle.press("ArrowUp")
    assert handle.get_attribute("aria-valuenow") == "80"
    handle.press("Home")
    assert handle.get_attribute("aria-valuenow") == "0"


def test_where_the_page_scrolls_a_finger_on_the_shape_scrolls_it(visit: Visit) -> None:
    studio = visit(size=(320, 480))
    assert studio["#canvas"].evaluate("c => getComputedStyle(c).touchAction") == "pan-y"
    assert studio.page.evaluate("document.documentElement.scrollHeight > innerHeight")
