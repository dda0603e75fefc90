"""Pulls at the surface, which leave pins: what follows, what stays, and the page's messages."""

from typing import Any

import numpy as np
from playwright.sync_api import Locator

from tests.page.conftest import Open, Visit
from tests.page.studio import Hold, OpenPage, difference
from tests.page.test_operation import AXE, check


def hand(studio: OpenPage, right: bool = True) -> tuple[float, float]:
    """Window position of the figure's hand on one side of the picture."""
    picture, box = studio.picture(), studio["#canvas"].bounding_box()
    assert box
    ink = np.abs(picture - picture[0, 0]).max(axis=2) > 40
    ink = ink[: len(ink) // 2]  # text is below
    columns = np.flatnonzero(ink.any(axis=0))
    x = int(columns[-1] - 6 if right else columns[0] + 6)
    return box["x"] + x, box["y"] + 60 + int(np.median(np.flatnonzero(ink[:, x])))


def pull(studio: OpenPage, place: tuple[float, float], by: tuple[float, float]) -> None:
    mouse = studio.page.mouse
    mouse.move(*place)
    mouse.down()
    for share in (0.5, 1):
        mouse.move(place[0] + share * by[0], place[1] + share * by[1])
    mouse.up()


def edits(studio: OpenPage) -> list[dict[str, Any]]:
    """A list to which the bodies of all later `edit` requests are added."""
    sent: list[dict[str, Any]] = []
    studio.page.on("request", lambda request: "/edit" in request.url and sent.append(request.post_data_json))
    return sent


def corners(pins: Locator) -> list[list[float]]:
    """Upper left corners of pins, in window coordinates."""
    return pins.evaluate_all(
        "all => all.map((pin) => { const { x, y } = pin.getBoundingClientRect(); return [x, y]; })"
    )


def test_pins_stay_are_pulled_together_and_removed_by_mouse_and_key(visit: Visit) -> None:
    studio = visit("#model=figure")
    sent = edits(studio)
    studio["#pull"].click()
    first, second = hand(studio), hand(studio, right=False)
    pull(studio, first, (20, -25))
    studio.eventually(lambda: "The shape has followed" in studio.messages)
    studio.rest()
    assert hand(studio)[0] > first[0] + 10
    pins = studio[".pin"]
    assert pins.count() == 1
    at = pins.first.bounding_box()
    assert at
    assert abs(at["x"] + at["width"] / 2 - first[0] - 20) < 5
    assert abs(at["y"] + at["height"] / 2 - first[1] + 25) < 5
    assert len(sent[-1]["targets"]) == 1
    assert sent[-1]["anchored"] is True
    one = studio.code
    pull(studio, second, (-15, -20))
    studio.eventually(lambda: len(sent[-1]["targets"]) == 2 and studio.code != one)
    studio.rest()
    assert pins.count() == 2
    studio.page.evaluate(AXE.read_text())
    check(studio, "pins")

    # A link restores the pins and the shape with its placement.
    places = corners(pins)
    studio.eventually(lambda: studio.hash.get("pins", "").count(";") == 1 and "place" in studio.hash)
    address = studio.hash
    studio.page.reload()
    studio.rest()
    studio.eventually(lambda: pins.count() == 2)
    studio.eventually(lambda: np.allclose(corners(pins), places, atol=2))
    studio["#share"].click()  # which writes the address at once
    assert studio.hash == address

    # A single pin can be dragged further.
    box = pins.nth(1).bounding_box()
    assert box
    asked = len(sent)
    pull(studio, (box["x"] + 12, box["y"] + 12), (0, 25))
    studio.eventually(lambda: len(sent) > asked and studio[".pin.busy"].count() == 0)
    assert len(sent[-1]["targets"]) == 2
    assert pins.count() == 2
    studio.rest()

    pins.first.click()
    assert pins.count() == 1
    pins.first.focus()
    studio.page.keyboard.press("Delete")
    assert pins.count() == 0
    assert studio["#clear-pins"].is_hidden()
    assert studio["#canvas"].evaluate("c => document.activeElement === c")


def test_a_press_pins_a_place_and_undo_takes_pins_along(visit: Visit) -> None:
    studio = visit("#model=figure")
    studio["#pull"].click()
    studio.page.mouse.click(*hand(studio, right=False))
    studio.eventually(lambda: studio[".pin"].count() == 1)
    studio["#share"].click()  # which writes the address at once
    assert not any(studio.code)
    pull(studio, hand(studio), (20, -25))
    studio.eventually(lambda: any(studio.code))
    studio.rest()
    assert studio[".pin"].count() == 2
    studio["#undo"].click()
    studio.until_code([0] * 20)
    assert studio[".pin"].count() == 1
    studio["#redo"].click()
    studio.eventually(lambda: studio[".pin"].count() == 2)
    studio["#clear-pins"].click()
    assert studio[".pin"].count() == 0


def test_a_pull_whose_answer_is_late_ends_by_undo_and_with_its_model(visit: Visit) -> None:
    studio = visit("#model=figure")
    studio["#pull"].click()
    held = Hold(studio.page, "**/edit*")
    place = hand(studio)
    studio["#z0"].press("ArrowRight")
    moved = [float(studio["#z0"].input_value()), *19 * [0]]
    pull(studio, place, (20, -25))
    studio.eventually(lambda: len(held.routes) == 1)
    studio["#pull"].press("Control+z")
    studio.until_code(moved)
    assert studio[".pin"].count() == 0
    assert "1 step" in (studio["#undo"].get_attribute("title") or "")
    pull(studio, place, (20, -25))
    studio.eventually(lambda: len(held.routes) == 2)
    for model in ("with-fine", "figure"):
        studio.page.evaluate("hash => { location.hash = hash; }", f"#model={model}")
        studio.eventually(lambda model=model: studio["#model"].input_value() == model)  # type: ignore[misc]
    studio.rest()
    pull(studio, place, (20, -25))
    studio.eventually(lambda: len(held.routes) == 3)
    held.release()
    studio.eventually(lambda: any(studio.code))
    studio["#undo"].click()
    studio.until_code([0] * 20)
    assert studio[".pin"].count() == 0


def test_what_is_locked_stays_though_something_else_is_pulled(visit: Visit) -> None:
    locked = [k for k in range(20) if k != 7]  # all but a leg
    studio = visit(f"#model=figure&locked={','.join(map(str, locked))}")
    before = studio.picture()
    sent = edits(studio)
    studio["#pull"].click()
    pull(studio, hand(studio), (20, -40))
    studio.eventually(lambda: "does not reach the pin" in studio.messages and "stays as it was" in studio.messages)
    assert "Unlock" in studio.messages
    assert set(map(int, sent[-1]["fixed"])) == set(locked)
    assert studio.code == [] or not any(studio.code)
    studio["#clear-pins"].click()
    studio["[aria-label='Close this message']"].first.click()
    studio["#theme"].hover()
    studio["#theme"].focus()
    studio.rest()
    studio.eventually(lambda: difference(before, studio.picture()) < 0.001)


def test_a_press_beside_the_shape_pulls_it_and_marks_line_and_ring_say_what_happens(visit: Visit) -> None:
    studio = visit("#model=figure")
    studio["#pull"].click()
    mouse = studio.page.mouse
    x, y = hand(studio)
    mouse.move(x + 40, y)
    assert studio["#hover"].is_hidden()
    mouse.move(x + 15, y)  # the hand ends 6 pixels to the right of the place
    studio.eventually(studio["#hover"].is_visible)
    marked = studio["#hover"].bounding_box()
    assert marked
    assert np.hypot(marked["x"] + 8 - x - 15, marked["y"] + 8 - y) < 13
    held = Hold(studio.page, "**/edit*")
    mouse.down()
    assert studio["#hover"].is_hidden()
    mouse.move(x + 45, y - 40)
    studio.eventually(lambda: studio[".pin.busy"].count() == 1)
    # From the next picture on, a line joins the pin to the vertex, far away.
    studio.eventually(lambda: studio["#threads line"].evaluate("line => line.getTotalLength()") > 40)
    assert "view" not in studio.hash, "a near miss does not turn the view"
    mouse.up()
    held.release()
    studio.eventually(lambda: studio[".pin.busy"].count() == 0)
    studio.until_code(studio.eventually(lambda: studio.code if any(studio.code) else None))


def test_a_finger_pulls_and_a_second_one_does_not_turn_the_view(window: Open) -> None:
    studio = window(viewport={"width": 390, "height": 760}, has_touch=True, is_mobile=True).open("#model=figure")
    studio["#pull"].tap()
    devtools = studio.page.context.new_cdp_session(studio.page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    x, y = hand(studio)
    touch("touchStart", (x + 20, y))
    touch("touchMove", (x + 30, y - 20))
    touch("touchStart", (x + 30, y - 20), (x - 60, y + 90))
    touch("touchMove", (x + 30, y - 30), (x - 90, y + 60))
    touch("touchEnd")
    studio.eventually(lambda: any(studio.code))
    assert studio[".pin"].count() == 1
    studio.rest()
    assert "view" not in studio.hash


def test_the_camera_stays_above_the_ground_zooms_to_the_pointer_and_sees_all_by_a_double_click(
    visit: Visit,
) -> None:
    studio = visit("#model=figure")
    mouse = studio.page.mouse
    box = studio["#canvas"].bounding_box()
    assert box
    beside = box["x"] + 30, box["y"] + 150
    mouse.move(*beside)
    mouse.down()
    mouse.move(beside[0], beside[1] - 300, steps=5)  # up, so that the camera goes down
    mouse.up()

    def view() -> tuple[np.ndarray, np.ndarray]:
        numbers = [float(part) for part in studio.hash["view"].split(",")]
        return np.array(numbers[:3]), np.array(numbers[3:])

    studio.eventually(lambda: "view" in studio.hash)
    position, target = view()
    assert position[1] >= target[1] - 1e-4
    studio["#canvas"].focus()
    for _ in range(3):
        studio.page.keyboard.press("ArrowDown")
    studio["#share"].click()  # which writes the address at once
    assert view()[0][1] >= view()[1][1] - 1e-4

    studio["#canvas"].press("0")
    studio.eventually(lambda: "view" not in studio.hash)
    studio["#theme"].focus()  # so that the canvas has no focus ring
    x, y = hand(studio)
    mouse.move(x, y)
    for _ in range(6):
        mouse.wheel(0, -200)
    studio.eventually(lambda: "view" in studio.hash and np.linalg.norm(np.subtract(*view())) < 1.5)
    near = studio.eventually(lambda: hand_near(studio, x, y))
    assert near, "the hand stays under the pointer"
    mouse.dblclick(x, y)
    studio.eventually(lambda: covers(studio))


def hand_near(studio: OpenPage, x: float, y: float) -> bool:
    """Whether the shape is drawn under a place of the window."""
    picture, box = studio.picture(), studio["#canvas"].bounding_box()
    assert box
    row, column = int(y - box["y"] - 60), int(x - box["x"])
    part = picture[max(row - 8, 0) : row + 8, max(column - 8, 0) : column + 8]
    return bool((np.abs(part - picture[0, 0]).max(axis=2) > 40).any())


def covers(studio: OpenPage) -> bool:
    """Whether all of the figure is drawn, in the middle."""
    picture = studio.picture()
    rows, columns = np.nonzero(picture[..., 0] - picture[..., 2] > 20)
    height, width = picture.shape[:2]
    inside = columns.min() > 3 and columns.max() < width - 3
    return bool(inside and np.ptp(rows) > 0.6 * height and abs(columns.mean() - width / 2) < 0.15 * width)
