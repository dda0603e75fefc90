"""The shelf of named shapes, and two shapes side by side."""

import httpx
import numpy as np
import pytest
from playwright.sync_api import Route

from shapespace.files.reading import read_arrays
from tests.page.conftest import Open
from tests.page.studio import Hold, OpenPage, difference


def kept(studio: OpenPage) -> list[str]:
    names: list[str] = studio["#shelf input"].evaluate_all("boxes => boxes.map((box) => box.value)")
    return names


def focused(studio: OpenPage) -> str:
    label: str = studio.page.evaluate("document.activeElement.getAttribute('aria-label') ?? ''")
    return label


def test_shapes_are_kept_by_name_for_each_model(window: Open) -> None:
    studio = window().open("#model=with-fine&z=0.1,1,0.5")
    held = Hold(studio.page, "**/vertices*")
    studio["#keep-shape"].click()
    studio.page.keyboard.type("Thin")  # the name is selected
    studio.page.keyboard.press("Control+z")  # undoes the typing, not the shape
    studio.page.keyboard.type("Thin")
    studio.page.keyboard.press("Tab")
    assert kept(studio) == ["Thin"]
    assert focused(studio) == "Compare with Thin"
    held.release()
    studio.eventually(lambda: studio["#shelf canvas.drawn"].count() == 1)  # though it had its name first
    studio.until_code([0.1, 1, 0.5])
    studio.slide(0, -0.1)
    studio.until_code([-0.1, 1, 0.5])
    studio["#keep-shape"].click()
    assert kept(studio) == ["Thin", "Shape 1"]
    pictures = [studio["#shelf canvas.drawn"].nth(k) for k in range(2)]
    first, second = (picture.evaluate("c => c.toDataURL()") for picture in pictures)
    assert first != second

    studio.page.get_by_role("button", name="Go to Thin").click()
    studio.until_code([0.1, 1, 0.5])
    studio["#undo"].click()
    studio.until_code([-0.1, 1, 0.5])

    studio.page.reload()
    studio.rest()
    assert kept(studio) == ["Thin", "Shape 1"]
    studio["#shelf input"].first.fill(" ")
    studio["#shelf input"].first.blur()
    assert kept(studio)[0] == "Thin", "a blank name is refused"
    studio.page.get_by_role("button", name="Remove Thin").click()
    assert kept(studio) == ["Shape 1"]
    assert focused(studio) == "Go to Shape 1"

    studio["#model"].select_option("figure")
    studio.eventually(lambda: kept(studio) == [])
    studio["#model"].select_option("with-fine")
    studio.eventually(lambda: kept(studio) == ["Shape 1"])


def test_a_shelf_that_was_spoilt_is_empty(window: Open) -> None:
    studio = window()
    studio.open("#model=with-fine")
    for spoilt in ("{", '[{"name": 3, "code": [0, 0, 0]}, {"name": "a", "code": [1]}]'):
        studio.page.evaluate("text => localStorage.setItem('shelf:with-fine', text)", spoilt)
        studio.page.reload()
        studio.rest()
        assert kept(studio) == []
    studio["#keep-shape"].click()
    assert kept(studio) == ["Shape 1"]


def test_two_shapes_beside_each_other(window: Open) -> None:
    studio = window().open("#model=with-fine&z=0.2,1,0.5")
    studio["#keep-shape"].click()
    studio["#reset-all"].click()
    studio.until_code([0, 0, 0])
    studio.rest()
    alone = studio.picture()
    button = studio.page.get_by_role("button", name="Compare with Shape 1")
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    both = studio.until_different(alone, 0.02)
    half = both.shape[1] // 2
    paper = np.median(both, axis=(0, 1))
    for side in (both[:, :half], both[:, half:]):
        assert (np.abs(side - paper).max(axis=2) > 40).mean() > 0.02, "there must be a shape on each side"
    studio.eventually(lambda: studio.hash.get("against") == "-2")

    studio.tab("Colour")
    assert studio["#against"].input_value() == "-2"
    studio.page.get_by_label("distance").check()
    studio.eventually(lambda: "diagonal" in (studio["#legend"].text_content() or ""))
    told = studio["#legend .numbers"].text_content() or ""
    most = float(told.rpartition("to ")[2].rstrip("%").strip())
    assert most == pytest.approx(furthest(studio), rel=0.15)

    studio.eventually(lambda: studio.hash.get("colour") == "distance")
    address = studio.page.url
    again = window()
    late: list[Route] = []

    def coarse_comes_last(route: Route) -> None:
        asked = route.request.post_data_json
        if asked["mesh"] == "coarse" and asked["latents"] == [[0.2, 1, 0.5]]:
            late.append(route)
        else:
            route.continue_()

    again.page.route("**/vertices?*", coarse_comes_last)
    again.open(address.removeprefix(studio.url + "/"))
    again.eventually(lambda: difference(studio.picture(), again.picture()) < 0.002)
    assert late
    for route in late:
        with again.page.expect_response(route.request.url):
            route.continue_()
    again.frames(5)
    assert difference(studio.picture(), again.picture()) < 0.002
    assert again.hash["other"] == "0.2,1,0.5"
    studio.page.get_by_label("nothing", exact=True).check()
    studio.tab("Shape")
    button.click()
    studio["#canvas"].hover()
    studio.eventually(lambda: difference(studio.picture(), alone) < 0.002)
    assert studio["#against"].input_value() == "-1"


def test_from_the_shape_to_the_one_beside(studio: OpenPage) -> None:
    assert studio["#blend"].is_hidden()
    studio.type(1, -3)
    studio.until_code([0, -3, 0])
    studio["#keep-shape"].click()
    studio.type(1, 3)
    studio.type(2, 0.8)
    studio.until_code([0, 3, 0.8])
    studio.coordinate(0).locator("input[type=range]").blur()
    studio.page.get_by_role("button", name="Compare with Shape 1").click()
    steps = studio["#undo"].get_attribute("title")
    slider = studio["#blend input"]
    slider.focus()
    with studio.keys_in_a_row():
        for _ in range(3):
            studio.page.keyboard.press("PageUp")
        slider.blur()
    share = float(slider.input_value())
    assert share > 0
    assert slider.get_attribute("aria-valuetext") == f"{share:.0%}".replace("%", " %")
    angle = 3 + share * (2 * np.pi - 6)  # the shorter way round
    studio.until_code([0, angle - 2 * np.pi * (angle > np.pi), 0.8 * (1 - share)], 1e-3)
    studio["#undo"].click()
    studio.until_code([0, 3, 0.8])
    assert studio["#undo"].get_attribute("title") == steps
    assert slider.input_value() == "0"

    studio.coordinate(2).locator("[data-do=lock]").click()
    slider.fill("1")
    studio.until_code([0, -3, 0.8])
    slider.fill("0")
    studio.until_code([0, 3, 0.8])
    slider.fill("1")
    studio.slide(0, 0.1)
    assert slider.input_value() == "0", "it is reset when the shape changes by other means"
    studio.page.get_by_role("button", name="Compare with Shape 1").click()
    assert studio["#blend"].is_hidden()


def test_the_view_stays_as_it_was_turned(studio: OpenPage, window: Open) -> None:
    studio["#keep-shape"].click()
    studio.slide(0, 0.2)
    studio["#canvas"].focus()
    studio.page.keyboard.press("ArrowRight")

    def direction() -> np.ndarray:
        view = np.array([float(x) for x in studio.eventually(lambda: studio.hash.get("view")).split(",")])
        way = view[:3] - view[3:]
        return np.concatenate([way / np.linalg.norm(way), [np.linalg.norm(way)]])

    before = direction()
    alone = studio.hash["view"]
    compare = studio.page.get_by_role("button", name="Compare with Shape 1")
    compare.click()
    studio.eventually(lambda: studio.hash["view"] != alone)
    after = direction()
    assert np.allclose(before[:3], after[:3], atol=1e-3)
    assert after[3] > before[3], "the camera moves back to show both"
    studio.rest()
    studio["#canvas"].hover()
    again = window().open(studio.page.url.removeprefix(studio.url + "/"))
    again.eventually(lambda: difference(studio.picture(), again.picture()) < 0.01)
    assert again.hash["view"] == studio.hash["view"]
    compare.click()
    studio.eventually(lambda: np.allclose(direction(), before, atol=1e-3))
    studio["#reset-view"].click()
    studio.eventually(lambda: "view" not in studio.hash)


def test_two_shapes_fit_however_near_the_view_was(studio: OpenPage) -> None:
    studio["#keep-shape"].click()
    studio.slide(0, 0.2)
    studio["#canvas"].focus()
    # In one task, so that the address gets no view between two keys.
    press = "(c, keys) => keys.forEach((key) => c.dispatchEvent(new KeyboardEvent('keydown', { key })))"
    studio["#canvas"].evaluate(press, ["+"] * 6 + ["ArrowRight"] * 4)
    studio.rest()
    alone = studio.picture()
    near = studio.eventually(lambda: studio.hash.get("view"))
    compare = studio.page.get_by_role("button", name="Compare with Shape 1")
    compare.click()
    studio["#canvas"].hover()
    both = studio.until_different(alone, 0.02)
    studio.eventually(lambda: studio.hash["view"] != near)
    edges = np.concatenate([both[:, :3].reshape(-1, 3), both[:, -3:].reshape(-1, 3)])
    assert np.ptp(edges, axis=0).max() < 24, "a shape is cut off"
    compare.click()
    studio.eventually(lambda: np.allclose(numbers(studio.hash["view"]), numbers(near), atol=1e-3))


def numbers(view: str) -> list[float]:
    return [float(number) for number in view.split(",")]


def test_two_windows_have_one_shelf(studio: OpenPage) -> None:
    other = OpenPage(studio.page.context.new_page(), studio.url).open()
    studio["#keep-shape"].click()
    other.eventually(lambda: kept(other) == ["Shape 1"])
    other["#keep-shape"].click()
    studio.eventually(lambda: kept(studio) == ["Shape 1", "Shape 2"])


def furthest(studio: OpenPage) -> float:
    """Largest distance between the two shapes, from the server, in percent of the reference's diagonal."""

    def vertices(*code: float) -> np.ndarray:
        latent = ",".join(map(str, code))
        query = {"format": "obj"} | ({"latent": latent} if latent else {})
        answer = httpx.get(f"{studio.url}/v1/models/with-fine/mesh", params=query)
        return read_arrays(answer.content, "obj")[0]

    reference = vertices()
    apart = np.linalg.norm(vertices(0, 0, 0) - vertices(0.2, 1, 0.5), axis=1).max()
    return float(100 * apart / np.linalg.norm(np.ptp(reference, axis=0)))
