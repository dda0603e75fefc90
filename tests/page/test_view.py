"""The view of the shape: turned, zoomed, coloured, in every window."""

import numpy as np

from tests.page.conftest import Open, Visit
from tests.page.studio import OpenPage, body, difference

BACKGROUND = 12  # largest difference between colours of the background


def test_turn_and_zoom_by_mouse_and_keyboard(studio: OpenPage) -> None:
    start = studio.picture()
    box = studio["#canvas"].bounding_box()
    assert box
    x, y = box["x"] + 30, box["y"] + box["height"] - 100
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    studio.page.mouse.move(x + 120, y - 40, steps=4)
    studio.page.mouse.up()
    turned = studio.until_different(start, 0.01)
    studio.page.mouse.wheel(0, -600)
    zoomed = studio.until_different(turned, 0.01)
    studio["#canvas"].focus()
    for key in ("ArrowLeft", "ArrowUp", "-"):
        studio.page.keyboard.press(key)
        zoomed = studio.until_different(zoomed, 0.005)
    studio.eventually(lambda: "view" in studio.hash)
    studio.page.keyboard.press("0")
    studio["#theme"].focus()  # so that the canvas has no focus ring
    studio.eventually(lambda: difference(start, studio.picture()) < 0.001)
    assert studio.code == [0, 0, 0]


def test_wireframe_normals_and_the_coarse_mesh(studio: OpenPage) -> None:
    start = studio.picture()
    for switch in ("wireframe", "normals", "fine"):
        before = studio.picture()
        studio[f"#{switch}"].click()
        assert studio[f"#{switch}"].get_attribute("aria-pressed") == str(switch != "fine").lower()
        studio.until_different(before, 0.005)
        if switch == "fine":
            studio.eventually(lambda: studio.shown == "coarse")
            assert "64 vertices" in (studio["#frame-time"].text_content() or "")
    for switch in ("wireframe", "normals", "fine"):
        studio[f"#{switch}"].click()
    studio.eventually(lambda: difference(start, studio.picture()) < 0.001)


def test_the_fine_shape_lies_where_the_coarse_one_does(visit: Visit) -> None:
    # Aligned over its own vertices each, they would differ by 5 degrees about the vertical axis.
    studio = visit(f"#model=figure&z={','.join(['0.6'] * 20)}")

    def ink() -> np.ndarray:
        picture = studio.picture()
        return np.abs(picture - picture[0, 0]).max(axis=2) > 2 * BACKGROUND

    fine = ink()
    studio["#fine"].click()
    studio.rest()
    coarse = ink()
    assert (fine & coarse).sum() > 0.96 * (fine | coarse).sum()


def test_pointing_at_a_factor_colours_where_it_changes_lengths_and_angles(visit: Visit) -> None:
    studio = visit("#model=figure")
    every = studio[".end canvas"].count()
    studio.eventually(lambda: studio[".end canvas.drawn"].count() == every)

    def blue(picture: np.ndarray) -> np.ndarray:
        return (picture[..., 2] - picture[..., 0]) > 50

    # Folded factors show a picture of the part of the shape that they change.
    folds = studio[".factor details"]
    unfolded = [fold.get_attribute("open") is not None for fold in folds.all()]
    assert unfolded == [True, True] + [False] * (folds.count() - 2), "enough for three sliders"
    pictures = [body(canvas) for canvas in studio[".factor summary canvas"].all()]
    for picture in pictures:
        assert 0.01 < (blue(picture) & (picture[..., 3] > 0)).mean() < 0.5
    # No two pictures are alike; pictures of the whole shape nearly would be.
    assert all(np.abs(a - b).mean() > 5 for i, a in enumerate(pictures) for b in pictures[:i])
    studio[".factor summary"].nth(2).click()
    assert studio["#z4"].is_visible()

    studio["#canvas"].hover()
    studio.eventually(lambda: not blue(studio.picture()).any())
    studio[".factor h2"].filter(has_text="shoulder").first.hover()  # an arm, on one side of the picture
    coloured = blue(studio.eventually(lambda: p if blue(p := studio.picture()).any() else None))
    half = coloured.shape[1] // 2
    less, more = sorted(int(side.sum()) for side in (coloured[:, :half], coloured[:, half:]))
    assert more > 1000
    assert less < 0.05 * more
    studio["#canvas"].hover()
    studio.eventually(lambda: not blue(studio.picture()).any())
    # A hip: rigid alignment moves head, hands and feet too, but their lengths and angles don't change.
    studio[".factor h2"].first.hover()
    coloured = blue(studio.eventually(lambda: p if blue(p := studio.picture()).any() else None))
    height = len(coloured)
    assert not coloured[: int(0.4 * height)].any()
    assert not coloured[int(0.75 * height) :].any()


def test_pictures_of_each_coordinate(studio: OpenPage) -> None:
    studio.eventually(lambda: studio[".end canvas.drawn"].count() == 6)
    less, more = (body(studio.coordinate(0).locator("canvas").nth(i)) for i in range(2))
    covered = [(picture[..., 3] > 0).mean() for picture in (less, more)]
    assert covered[0] < covered[1], "this coordinate scales the shape"
    studio.coordinate(0).locator(".end").nth(1).click()
    studio.until_code([0.2, 0, 0])


def test_the_view_fits_every_window(studio: OpenPage) -> None:
    for width, height in ((1400, 500), (700, 900), (390, 700)):
        studio.page.set_viewport_size({"width": width, "height": height})
        studio.eventually(
            lambda: studio["#canvas"].evaluate("c => Math.abs(c.width - c.clientWidth * devicePixelRatio) < 2")
        )
        assert studio.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        studio.frames(2)
        picture = studio.picture()
        edges = np.concatenate([picture[:, :3].reshape(-1, 3), picture[:, -3:].reshape(-1, 3)])
        assert np.ptp(edges, axis=0).max() < 2 * BACKGROUND, "the shape is cut off"
        assert np.ptp(picture.reshape(-1, 3), axis=0).max() > 60, "the shape is gone"


def test_a_phone_and_a_finger(window: Open) -> None:
    studio = window(
        viewport={"width": 390, "height": 760}, has_touch=True, is_mobile=True, device_scale_factor=2
    ).open()
    assert studio.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    start = studio.picture()
    box = studio["#canvas"].bounding_box()
    assert box
    devtools = studio.page.context.new_cdp_session(studio.page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch("touchStart", (x, y))
    for i in range(1, 6):
        touch("touchMove", (x + 12 * i, y))
    touch("touchEnd")
    turned = studio.until_different(start, 0.01)
    touch("touchStart", (x - 20, y), (x + 20, y))
    for i in range(1, 6):
        touch("touchMove", (x - 20 - 8 * i, y), (x + 20 + 8 * i, y))
    touch("touchEnd")
    pinched = studio.until_different(turned, 0.01)
    target = studio.eventually(lambda: studio.hash.get("view")).split(",")[3:]
    touch("touchStart", (x - 20, y), (x + 20, y))
    for i in range(1, 6):
        touch("touchMove", (x - 20, y + 10 * i), (x + 20, y + 10 * i))
    touch("touchEnd")
    studio.until_different(pinched, 0.01)
    studio.eventually(lambda: studio.hash["view"].split(",")[3:] != target)
    slider = studio.coordinate(0).locator("input[type=range]")
    slider.scroll_into_view_if_needed()
    width = (slider.bounding_box() or {"width": 0.0})["width"]
    slider.tap(position={"x": 0.8 * width, "y": 12})
    studio.eventually(lambda: bool(studio.code) and studio.code[0] > 0)  # the picture may still change
    studio.page.get_by_role("tab", name="Path").tap()
    assert studio["#add-keyframe"].is_visible()


def test_a_stage_in_dark_and_light(window: Open) -> None:
    studio = window(color_scheme="dark").open()

    def stage() -> tuple[float, float, float]:
        """Brightness of the background, the ground beside the shape, and the darkest place of the ground."""
        picture = studio.picture()
        grey = picture.mean(axis=2)
        shape = (picture[..., 0] - picture[..., 2] > 20).any(axis=1)  # the shape's clay colour is warm
        ground = grey[np.flatnonzero(shape)[-1] + 3 :]
        return grey[:5].mean(), float(np.median(ground[:5, 60:90])), ground[:5].min()

    paper, ground, shadow = stage()
    assert paper < 60
    assert ground > paper + 8
    assert shadow < ground - 8
    studio["#theme"].click()
    paper, ground, shadow = studio.eventually(lambda: found if (found := stage())[0] > 200 else None)
    assert ground < paper - 8
    assert shadow < ground - 8
