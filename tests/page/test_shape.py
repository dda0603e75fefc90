"""The sliders, and the shapes that follow them: first drafts, then full ones."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Route

from shapespace import load
from tests.page.conftest import Open, Visit
from tests.page.studio import Hold, OpenPage, difference

BACKGROUND = 12  # largest difference between colours of the background


def test_the_figure_is_there_first_and_follows_a_slider(window: Open) -> None:
    studio = window().open("")
    assert studio["#model"].input_value() == "figure"
    assert studio["h1"].inner_text() == "shapespace"
    before = studio.picture()
    paper = before[:8].reshape(-1, 3)
    drawn = (np.abs(before - paper.mean(axis=0)).max(axis=2) > 4 * BACKGROUND).mean()
    assert 0.05 < drawn < 0.6, "the canvas must be neither blank nor filled"
    studio.slide(4, 0.9)
    after = studio.until_different(before, 0.01)
    assert 0.01 < difference(before, after) < 0.6
    studio.until_code([0] * 4 + [0.9] + [0] * 15, 1e-3)
    studio.rest()
    words = studio["#diagnostics"].text_content() or ""
    assert "Fits its lengths and angles to" in words
    assert "Inside the range" in words
    assert "ms to the picture" in (studio["#frame-time"].text_content() or "")


def test_several_coordinates_at_once_number_lock_and_reset(studio: OpenPage) -> None:
    start = studio.picture()
    studio.type(0, 0.15)
    studio.type(2, 0.5)
    studio.until_code([0.15, 0, 0.5])
    assert float(studio.coordinate(0).locator("input[type=range]").input_value()) == pytest.approx(0.15)
    studio.until_different(start)

    studio.coordinate(0).locator("[data-do=lock]").click()
    assert studio.coordinate(0).locator("input[type=range]").is_disabled()
    studio["#reset-all"].click()
    studio.until_code([0.15, 0, 0])
    assert studio.hash["locked"] == "0"
    studio.coordinate(0).locator("[data-do=lock]").click()
    studio.coordinate(0).locator("[data-do=reset]").click()
    studio.until_code([0, 0, 0])
    studio["#canvas"].hover()  # leave the factor, which colours what it changes
    studio.eventually(lambda: difference(start, studio.picture()) < 0.001)

    studio.type(1, 1)
    studio.type(2, 0.4)
    studio.type(0, 0.1)
    studio.until_code([0.1, 1, 0.4])
    studio[".factor"].nth(1).get_by_role("button", name="Reset all of form").click()
    studio.until_code([0.1, 0, 0])


def test_the_range_of_the_training_data_is_marked_and_leaving_it_is_said(studio: OpenPage) -> None:
    slider = studio.coordinate(2).locator("input[type=range]")
    low, high = (
        float(slider.evaluate(f"s => s.style.getPropertyValue('--{end}')").rstrip("%")) for end in ("low", "high")
    )
    lowest, highest = float(slider.get_attribute("min") or 0), float(slider.get_attribute("max") or 0)
    assert lowest + low / 100 * (highest - lowest) == pytest.approx(0, abs=1e-6)
    assert lowest + high / 100 * (highest - lowest) == pytest.approx(1)
    assert "outside" not in (studio.coordinate(2).get_attribute("class") or "")
    studio.slide(2, 1.2)
    assert "outside" in (studio.coordinate(2).get_attribute("class") or "")
    studio.eventually(lambda: "Outside the range" in (studio["#diagnostics"].text_content() or ""))


def test_a_number_beyond_the_slider_is_refused_with_its_bound(studio: OpenPage) -> None:
    studio.asked.clear()
    box = studio.coordinate(0).locator("input[type=number]")
    line = studio.coordinate(0).locator(".bound")
    for typed, words, end in ((99, "largest", 0.32), (-99, "smallest", -0.32), (1e39, "largest", 0.32)):
        box.fill(str(typed))
        assert line.inner_text() == f"The {words} value here is {end}."
        assert box.get_attribute("aria-invalid") == "true"
        assert float(box.input_value()) == typed, "it may be the beginning of another number"
        box.press("Enter")
        assert float(box.input_value()) == end
        assert box.get_attribute("aria-invalid") == "false"
        studio.until_code([end, 0, 0])
    box.fill("0.1")
    assert line.is_hidden()
    studio.until_code([0.1, 0, 0])
    studio.rest()
    assert all(abs(asked["latents"][0][0]) < 0.4 for asked in studio.asked)


@pytest.mark.parametrize("model", ["with-fine", "figure"])
def test_a_shape_of_another_code_is_grey_below_a_ring_and_has_no_verdict(visit: Visit, model: str) -> None:
    studio = visit(f"#model={model}")
    before = studio.picture()
    held = Hold(studio.page, "**/vertices*")
    studio.type(2, 0.5)
    studio.eventually(lambda: studio.waits)
    assert studio["#busy"].is_visible()
    assert studio["#diagnostics summary"].inner_text() == "Computing this shape …"
    assert studio["#found li"].count() == 0
    clay = (before[..., 0] - before[..., 2]) > 20
    assert clay.mean() > 0.03
    studio.eventually(lambda: (np.subtract(*np.moveaxis(studio.picture()[..., ::2], 2, 0))[clay] > 20).mean() < 0.05)
    held.release()
    studio.rest()
    assert not studio.waits
    assert studio["#busy"].is_hidden()
    assert studio["#found li"].count() > 1


def test_the_verdict_is_that_of_the_draft_on_the_screen(studio: OpenPage) -> None:
    studio.page.route("**/vertices*", lambda route: '"full"' in (route.request.post_data or "") or route.continue_())
    studio.type(2, 1.2)
    studio.eventually(lambda: "Outside the range" in (studio["#diagnostics"].text_content() or ""))
    studio.eventually(lambda: studio.quality == "draft")
    studio.type(2, 0.5)
    studio.eventually(lambda: "Inside the range" in (studio["#diagnostics"].text_content() or ""))
    studio.eventually(lambda: studio.quality == "draft")
    studio.let_through()


def test_random_draws_likely_shapes_unless_the_menu_says_otherwise(visit: Visit) -> None:
    studio = visit("#model=figure")
    asked: list[dict[str, object]] = []
    studio.page.on("request", lambda request: "/sample" in request.url and asked.append(request.post_data_json))
    studio["#random"].click()
    studio.eventually(lambda: any(studio.code))
    likely = studio.code
    studio["#distribution"].select_option("uniform")
    studio.eventually(lambda: studio.code != likely and len(asked) == 2)
    assert [body["distribution"] for body in asked] == ["population", "uniform"]
    assert asked[0]["seed"] == asked[1]["seed"]
    assert np.abs(likely).mean() < np.abs(studio.code).mean()


def test_no_likely_shape_is_called_outside(visit: Visit, models: Path) -> None:
    model = load(models / "figure")
    drawn = (seed for seed in range(2, 30) if not model.latents.code(model.sample(1, seed, "population")[0])[1])
    studio = visit("#model=figure")
    for seed in itertools.islice(drawn, 2):
        studio["#seed"].fill(str(seed))
        studio["#seed"].press("Enter")
        studio.until_code(np.clip(model.sample(1, seed, "population")[0], model.lower, model.upper))
        studio.rest()
        assert model.latents.code(studio.code)[1]
        assert "Inside the range" in (studio["#diagnostics"].text_content() or "")


def test_an_angle_goes_round(studio: OpenPage) -> None:
    studio.type(1, 4)
    studio.until_code([0, 4 - 2 * np.pi, 0])
    slider = studio.coordinate(1).locator("input[type=range]")
    step = 2 * np.pi / 100
    studio.type(1, 3.14)
    slider.press("ArrowRight")
    studio.until_code([0, 3.14 + step - 2 * np.pi, 0], 1e-3)
    slider.press("ArrowLeft")
    studio.until_code([0, 3.14, 0], 1e-3)


def test_drafts_as_it_moves_the_full_shape_as_it_rests_and_nothing_queues(studio: OpenPage) -> None:
    studio.asked.clear()
    values = np.linspace(0.01, 0.15, 40).tolist()
    studio.coordinate(0).locator("input[type=range]").evaluate(
        """(slider, values) => {
            for (slider.value of values) slider.dispatchEvent(new Event('input', { bubbles: true }));
        }""",
        values,
    )
    studio.rest()
    fine = [asked for asked in studio.asked if asked["mesh"] == "fine"]  # the small pictures are coarse
    # Of the changes during the first request only the last is sent.
    assert [asked["quality"] for asked in fine] == ["draft", "draft", "full"]
    assert [asked["latents"][0][0] for asked in fine] == pytest.approx([0.01, 0.15, 0.15])


def test_a_draft_turns_into_the_full_shape_pixel_by_pixel(studio: OpenPage) -> None:
    script = """async ([draft, full]) => {
        const { between } = await import('/page/js/server/shape-loop.js');
        return Array.from(between(Float64Array.from(draft), Float64Array.from(full)), (x) => Array.from(x));
    }"""
    full = np.random.default_rng(0).uniform(-1, 1, 300)
    full[:2] = -1, 1
    for away, steps in ((0.0, 0), (0.001, 0), (0.01, 5), (1.0, 23)):
        draft = full + away * np.linspace(-1, 1, 300)
        way = np.reshape(studio.page.evaluate(script, [draft.tolist(), full.tolist()]), (-1, 300))
        assert len(way) == steps
        moves = np.abs(np.diff(np.concatenate([[draft], way, [full]]), axis=0)).max(axis=1)
        assert moves == pytest.approx(moves.mean(), rel=1e-6)
        assert away == 1 or moves.max() <= 2 / 1080


def test_shapes_that_take_their_time_are_asked_for_once(window: Open) -> None:
    studio = window()
    studio.page.clock.install()
    studio.open()
    waiting: list[Route] = []

    def keep(route: Route) -> None:
        is_shown = '"fine"' in (route.request.post_data or "")  # the small pictures are coarse
        waiting.append(route) if is_shown else route.continue_()

    studio.page.route("**/vertices*", keep)
    studio.asked.clear()
    studio.type(0, 0.11)
    studio.eventually(lambda: bool(waiting))
    studio.type(0, 0.12)
    for _ in range(3):
        studio.eventually(lambda: bool(waiting))
        studio.page.clock.fast_forward(500)
        waiting.pop(0).continue_()
    studio.rest()
    studio.page.clock.fast_forward(1000)
    studio.frames(3)
    assert [asked["quality"] for asked in studio.asked if asked["mesh"] == "fine"] == ["draft", "draft", "full"]


def test_a_draft_that_was_solved_after_all_is_not_asked_for_again(window: Open) -> None:
    studio = window()
    studio.page.clock.install()
    # So far outside the bounds, face frames give a bad shape.
    studio.open(f"#model=figure&z={','.join(['3,-3'] * 10)}")
    studio.page.clock.fast_forward(1000)
    studio.frames(3)
    fine = [asked for asked in studio.asked if len(asked["latents"]) == 1 and asked["mesh"] == "fine"]
    assert {asked["quality"] for asked in fine} == {"draft"}
    assert "folded over" in (studio["#diagnostics"].text_content() or "")


def test_nothing_jumps_as_a_draft_comes_to_rest(visit: Visit) -> None:
    studio = visit("#model=figure")
    every = studio[".end canvas"].count()
    studio.eventually(lambda: studio[".end canvas.drawn"].count() == every)
    held: list[Route] = []
    studio.page.route(
        "**/vertices*",
        lambda route: held.append(route) if '"full"' in (route.request.post_data or "") else route.continue_(),
    )
    start = studio.picture()
    studio.type(3, 0.6)
    # Leave the factor, which colours what it changes while it is pointed at or edited.
    studio.coordinate(3).locator("input[type=number]").blur()
    studio["#canvas"].hover()
    studio.eventually(lambda: bool(held) and (studio.shown, studio.quality) == ("fine", "draft"))
    studio.frames(2)
    draft = studio.picture()
    for route in held:
        route.continue_()
    studio.rest()
    assert difference(start, draft) > 0.01
    assert difference(draft, studio.picture()) < 0.25 * difference(start, draft)


def test_one_line_says_how_good_the_shape_is_by_what_is_usual_for_the_model(window: Open) -> None:
    studio = window()
    residual = 0.02

    def off(route: Route) -> None:
        answer = route.fetch()
        told = json.loads(answer.headers["shape-diagnostics"]) | {"residual": residual, "plausibility": 1}
        route.fulfill(response=answer, headers={**answer.headers, "shape-diagnostics": json.dumps(told)})

    studio.page.route("**/vertices*", off)
    studio.open()
    studio.eventually(lambda: studio[".end canvas.drawn"].count() == 6)
    chip = studio["#diagnostics summary"]
    assert chip.inner_text() == "Looks right", "all shapes of this model have as large a residual"
    assert studio["#diagnostics"].get_attribute("class") == "good"
    assert studio["#found"].is_hidden()
    chip.click()
    assert "as is usual for this model" in studio["#found"].inner_text()
    residual = 0.06
    studio.type(2, 0.4)
    studio.eventually(lambda: chip.inner_text() == "Fits less well")
    # busy while a better shape of the same code is on its way
    studio.eventually(lambda: studio["#diagnostics"].get_attribute("class") == "fair")
    residual = 0.2
    studio.type(2, 0.5)
    studio.eventually(lambda: chip.inner_text() == "Hardly exists")
    studio.eventually(lambda: studio["#diagnostics"].get_attribute("class") == "poor")


def test_a_slider_is_dragged(studio: OpenPage) -> None:
    before = studio.picture()
    box = studio.coordinate(0).locator("input[type=range]").bounding_box()
    assert box
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    for i in range(10):
        studio.page.mouse.move(x + 8 * i, y)
    during = studio.until_different(before)
    assert studio["#undo"].is_disabled(), "a drag becomes one undo step when it ends"
    studio.page.mouse.up()
    studio.eventually(lambda: any(studio.code))
    assert studio.code[0] > 0.05
    studio["#undo"].click()
    studio.until_code([0, 0, 0])
    studio["#canvas"].hover()
    studio.until_different(during)


def test_a_shape_that_is_already_old_is_dropped(studio: OpenPage) -> None:
    dropped: list[str] = []
    studio.page.on("requestfailed", lambda request: dropped.append(request.post_data or ""))
    studio.page.route("**/vertices*", lambda route: '"full"' in (route.request.post_data or "") or route.continue_())
    studio.type(0, 0.1)
    studio.eventually(
        lambda: any(asked["quality"] == "full" and asked["latents"][0][0] == 0.1 for asked in studio.asked)
    )
    studio.type(0, 0.12)
    studio.eventually(lambda: any('"full"' in text and "0.1," in text for text in dropped))
    studio.let_through()
    studio.type(0, 0.13)
    studio.rest()
    assert studio.messages == ""


def test_undo_and_redo(studio: OpenPage) -> None:
    assert studio["#undo"].is_disabled()
    start = studio.picture()
    studio.slide(0, 0.1)
    studio.until_code([0.1, 0, 0])
    studio.slide(2, 0.6)
    studio.until_code([0.1, 0, 0.6])
    studio["#undo"].click()
    studio.until_code([0.1, 0, 0])
    studio.page.keyboard.press("Control+z")
    studio.until_code([0, 0, 0])
    assert studio["#undo"].is_disabled()
    studio.eventually(lambda: difference(start, studio.picture()) < 0.001)
    studio.page.keyboard.press("Control+Shift+z")
    studio["#redo"].click()
    studio.until_code([0.1, 0, 0.6])
    studio["#undo"].click()
    studio.type(1, 1)
    studio.until_code([0.1, 1, 0])
    assert studio["#redo"].is_disabled(), "a new step clears the redo steps"
