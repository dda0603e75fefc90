"""The page with missing browser features, failing servers and unusual user input."""

import json
import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Route

from tests.page.conftest import CHROMIUM, Open, Visit
from tests.page.studio import PATIENCE, Hold, OpenPage
from tests.page.test_path import keyframes
from tests.service.conftest import Server, Start
from tests.service.watching import free_port


def without(studio: OpenPage) -> None:
    studio.eventually(studio["#without"].is_visible)
    assert studio["#lost"].is_hidden()
    assert "WebGL" in studio["#without"].inner_text()
    assert (studio["h1 span"].bounding_box() or {"width": 0})["width"] > 50, "the page says its name"
    assert studio["h1 span"].evaluate("e => getComputedStyle(e).clipPath") == "none"
    assert "v1/models/NAME/mesh" in studio["#without"].inner_text()
    assert studio["#without a"].first.is_visible()
    assert studio["button:visible"].count() == 0
    assert studio["main"].is_hidden()


def test_without_scripts_the_calls_are_told(window: Open) -> None:
    studio = window(java_script_enabled=False)
    studio.page.goto(studio.url)
    without(studio)


def test_without_webgl_the_calls_are_told(browser: Browser, server: Server) -> None:
    flags = ["--disable-gpu", "--disable-3d-apis"]
    alone = browser.browser_type.launch(executable_path=CHROMIUM, args=flags, timeout=1000 * PATIENCE)
    try:
        studio = OpenPage(alone.new_page(), server.url)
        studio.page.goto(studio.url)
        without(studio)
        assert studio.complaints == []
    finally:
        alone.close()


def test_nothing_can_be_pressed_before_the_model_is_there(window: Open) -> None:
    studio = window()
    held: list[Route] = []
    studio.page.route("**/v1/models", lambda route: held.append(route) or None)
    studio.page.goto(studio.url)
    studio.eventually(lambda: bool(held))
    for selector in ("#random", "#about", "#undo", "#add-keyframe", "#reset-view", "#fine", "#canvas"):
        assert studio[selector].evaluate("e => e.closest('[inert]') !== null"), selector
        studio[selector].evaluate("e => e.focus()")
        assert studio[selector].evaluate("e => document.activeElement !== e"), selector
    studio["#mesh-file"].set_input_files({"name": "a.obj", "mimeType": "model/obj", "buffer": b"v 0 0 0"})
    studio.eventually(lambda: "No model is loaded yet" in studio.messages)
    assert "null" not in studio.messages
    held[0].continue_()
    studio.rest()
    assert studio["[inert]"].count() == 0
    studio["#random"].click()
    studio.eventually(lambda: any(studio.code))


@pytest.mark.long
def test_the_picker_and_download_while_the_server_is_away_and_after(window: Open, start: Start, models: Path) -> None:
    port = free_port()
    server = start(models, port=port)
    studio = window(server.url, complains=True).open()
    server.stop()
    studio["#model"].select_option("Figure")
    studio.eventually(lambda: "does not answer" in studio.messages)
    studio.eventually(lambda: studio["#model"].input_value() == "with-fine")
    studio.tab("Path")
    studio["#add-keyframe"].click()
    studio["#add-keyframe"].click()
    start(models, port=port)
    with studio.page.expect_download() as download:
        studio["#download-animation"].click()
    assert download.value.suggested_filename == "with-fine-animation.glb"
    assert not any("undefined" in address for address in studio.addresses)
    studio["#model"].select_option("Figure")
    studio.eventually(lambda: studio.hash.get("model") == "figure")


def test_a_model_that_is_not_served_is_told(window: Open) -> None:
    studio = window().open("#model=dragon&z=0.1")
    studio.eventually(lambda: "asks for the model dragon, which is not served here. This is Figure" in studio.messages)


def test_a_second_click_on_play_waits_for_the_same_frames(studio: OpenPage) -> None:
    keyframes(studio, (-0.2, 0, 0), (0.2, 0, 1))
    studio.rest()
    held: list[Route] = []
    frames: list[int] = []

    def hold(route: Route) -> None:
        asked = route.request.post_data_json
        held.append(route) if asked["quality"] == "draft" and not frames else route.continue_()
        frames.extend([len(asked["latents"])] if asked["quality"] == "draft" else [])  # pictures are full shapes

    studio.page.route("**/vertices?*", hold)
    studio["#play"].click()
    studio.eventually(lambda: bool(held))
    studio["#play"].click()
    studio.frames(3)
    held[0].continue_()
    studio.eventually(lambda: frames[:3] == [12, 12, 1])
    studio.eventually(lambda: studio["#time"].inner_text() == "t = 1.00")
    assert studio.messages == ""


@pytest.mark.parametrize("width", [1000, 390])
def test_numbers_are_not_cut(visit: Visit, width: int) -> None:
    studio = visit(size=(width, 760))
    box = studio.coordinate(1).locator("input[type=number]")
    box.fill("-3.1234")
    assert box.evaluate("b => b.scrollWidth <= b.clientWidth")
    script = "b => { b.value = '-300000.1234'; return b.scrollWidth <= b.clientWidth; }"
    assert not box.evaluate(script), "the measurement must detect a number that is cut off"


def test_theme_tab_and_seed_survive_a_reload(window: Open) -> None:
    studio = window().open()
    before = studio["html"].evaluate("e => getComputedStyle(e).colorScheme")
    studio["#theme"].click()
    studio["#seed"].fill("41")
    studio["#random"].click()
    studio.eventually(lambda: any(studio.code))
    studio.tab("Colour")
    studio.page.reload()
    studio.rest()
    assert studio["html"].evaluate("e => getComputedStyle(e).colorScheme") != before
    assert studio["#seed"].input_value() == "42"
    assert studio["#to-colour"].get_attribute("aria-selected") == "true"
    assert studio["#tab-colour"].is_visible()
    assert studio["#tab-shape"].is_hidden()


def test_ten_arrow_keys_are_one_step(studio: OpenPage) -> None:
    slider = studio.coordinate(0).locator("input[type=range]")
    slider.focus()
    with studio.keys_in_a_row():
        for _ in range(10):
            studio.page.keyboard.press("ArrowRight")
        moved = float(slider.input_value())
        assert moved > 0
        studio.page.keyboard.press("Control+z")
    studio.until_code([0, 0, 0])
    assert studio["#undo"].is_disabled()
    studio["#redo"].click()
    studio.until_code([moved, 0, 0])
    slider.press("ArrowLeft")
    studio.coordinate(2).locator("input[type=range]").press("ArrowRight")
    studio.eventually(lambda: "3 steps" in (studio["#undo"].get_attribute("title") or ""))


@pytest.mark.parametrize(
    ("width", "height"),
    [(390, 760), (500, 320), *(pytest.param(*some, marks=pytest.mark.long) for some in ((320, 640), (1000, 640)))],
)
def test_legend_and_diagnostics_lie_apart(visit: Visit, width: int, height: int) -> None:
    studio = visit("#model=with-fine&z=0.4,0,2&colour=stretch", size=(width, height))
    studio.eventually(lambda: bool(studio["#legend .numbers"].inner_text()) and studio["#diagnostics li"].count() > 1)
    boxes = [studio[name].bounding_box() for name in (".tools", "#legend", "#diagnostics")]
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            assert a
            assert b
            apart = (
                a["x"] + a["width"] <= b["x"] + 1,
                b["x"] + b["width"] <= a["x"] + 1,
                a["y"] + a["height"] <= b["y"] + 1,
                b["y"] + b["height"] <= a["y"] + 1,
            )
            assert any(apart), boxes
    studio["#name"].scroll_into_view_if_needed()
    assert studio.page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.parametrize("loop", [False, True])
def test_the_file_lasts_as_long_as_the_player(studio: OpenPage, loop: bool) -> None:
    keyframes(studio, (-0.2, 0, 0), (0.2, 0, 1), (0.1, 0, 0))
    if loop:
        studio["#loop"].check()
        studio["#seconds"].fill("4")
        studio["#seconds"].press("Enter")
    studio.eventually(lambda: studio["#animation-format option"].count() > 0)
    with studio.page.expect_download() as download:
        studio["#download-animation"].click()
    content = Path(download.value.path()).read_bytes()
    facts = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])["asset"]["extras"]
    # By default the player takes 1.8 s from one keyframe to the next; a loop returns to the first keyframe.
    steps, segments = (facts["frames"], 3) if loop else (facts["frames"] - 1, 2)
    assert steps / facts["frames_per_second"] == pytest.approx(4 if loop else 1.8 * segments)


def test_a_browser_that_keeps_nothing_shows_the_page_all_the_same(window: Open) -> None:
    studio = window()
    studio.page.add_init_script(
        """for (const name of ["localStorage", "sessionStorage"]) {
            Object.defineProperty(window, name, { get() { throw new DOMException("blocked", "SecurityError"); } });
        }"""
    )
    studio.open()
    studio["#theme"].click()
    studio.tab("Path")
    studio["#random"].click()
    studio.rest()
    assert studio.messages == ""
    studio.tab("Shape")
    studio["#keep-shape"].click()
    studio.eventually(lambda: "This browser lets the page keep nothing" in studio.messages)
    assert studio["#shelf input"].input_value() == "Shape 1"


def test_a_model_left_and_opened_again_draws_its_pictures_once(window: Open) -> None:
    studio = window().open("#model=figure")
    held = Hold(studio.page, re.compile("with-fine/mesh.*mesh=fine"))
    for address in ("#model=with-fine", "#model=figure", "#model=with-fine"):
        studio.page.evaluate("hash => { location.hash = hash; }", address)
        studio.eventually(lambda address=address: studio["#model"].input_value() == address[7:])  # type: ignore[misc]
    studio.eventually(lambda: len(held.routes) == 2)
    held.release()
    studio.eventually(lambda: studio[".end canvas.drawn"].count() == 6)
    studio.rest()
    ends = [asked for asked in studio.asked if len(asked["latents"]) > 1 and len(asked["latents"][0]) == 3]
    assert len(ends) == 2, "one call for each factor"
    assert studio.messages == ""


def test_who_returns_before_another_model_has_arrived_stays(studio: OpenPage) -> None:
    studio.slide(0, 0.1)
    studio.until_code([0.1, 0, 0])
    for back in (
        lambda: studio["#model"].select_option("with-fine"),
        lambda: studio.page.evaluate("location.hash = '#model=with-fine&z=0.2,0,0'"),
    ):
        held = Hold(studio.page, re.compile("figure/mesh.*mesh=coarse"))
        studio["#model"].select_option("Figure")
        studio.eventually(lambda held=held: bool(held.routes))  # type: ignore[misc]
        back()
        studio.eventually(lambda: studio["#model"].input_value() == "with-fine")
        with studio.page.expect_response(held.routes[0].request.url):
            held.release()
        studio.frames(3)
        assert studio["#model"].input_value() == "with-fine"
        assert "Small torus" in studio.page.title()
        studio.let_through()
    studio.until_code([0.2, 0, 0])
