"""Keyframes, the path through them, and colours for differences of shapes."""

import io
import re
from itertools import pairwise

import httpx
import numpy as np
import pytest
from playwright.sync_api import Route

from tests.page.conftest import Visit
from tests.page.studio import Hold, OpenPage, body, difference

#: Presses play and, once the time has moved on, pause; run in the page, so that a busy machine doesn't press too late.
PLAY_A_WHILE = """async (button) => {
    const frame = () => new Promise(requestAnimationFrame);
    const time = () => Number(document.querySelector('#time').textContent.replace('t = ', ''));
    button.click();
    while (time() < 0.1) await frame();
    button.click();
}"""


def keyframes(studio: OpenPage, *codes: tuple[float, float, float]) -> None:
    """Set codes and make each a keyframe."""
    for i, code in enumerate(codes):
        for k, value in enumerate(code):
            studio.type(k, value)
        studio.until_code(code)
        studio.tab("Path")
        studio["#add-keyframe"].click()
        studio.tab("Shape")
        studio.eventually(lambda i=i: studio["#keyframes canvas.drawn"].count() == i + 1)
    studio.tab("Path")


def test_play_pause_and_the_sliders_follow(studio: OpenPage) -> None:
    studio.tab("Path")
    assert studio["#play"].is_disabled()
    assert studio["#seconds"].is_disabled()
    assert studio["#animation-format"].is_hidden(), "there is nothing to choose yet"
    studio.tab("Shape")
    keyframes(studio, (-0.2, 0, 0), (0.2, 0, 1))
    before = studio.picture()
    studio["#seconds"].fill("15")
    studio["#seconds"].dispatch_event("change")
    studio["#play"].evaluate(PLAY_A_WHILE)
    studio.until_different(before)
    assert "Play" in studio["#play"].inner_text()
    drafts = [len(asked["latents"]) for asked in studio.asked if asked["quality"] == "draft"]
    assert max(drafts) == 12
    assert studio.shown == "fine"
    studio.eventually(lambda: studio.code[2] not in {0, 1})
    size, angle, twist = studio.code
    assert angle == 0
    assert size == pytest.approx(-0.2 + 0.4 * twist, abs=1e-3), "on the line between the keyframes"
    t = float(studio["#time"].inner_text().removeprefix("t = "))
    assert twist == pytest.approx(t, abs=0.03)
    studio.rest()
    studio.eventually(lambda: not studio["#path-status"].inner_text())
    asked = len(studio.asked)
    studio["#seconds"].fill("1")
    studio["#seconds"].dispatch_event("change")
    studio["#play"].click()
    studio.eventually(lambda: studio["#time"].inner_text() == "t = 1.00")
    studio.eventually(lambda: "Play" in studio["#play"].inner_text())
    studio.until_code([0.2, 0, 1])
    assert len(studio.asked) <= asked + 2, "frames are requested only once"


@pytest.mark.long
def test_a_loop_goes_on_and_back_to_the_start(studio: OpenPage) -> None:
    keyframes(studio, (0, 0, 0), (0.1, 0, 1))
    studio["#loop"].check()
    assert studio["#beyond"].is_disabled()
    studio["#play"].click()
    times: list[float] = []

    def round_again() -> bool:
        times.append(float(studio["#time"].inner_text().removeprefix("t = ")))
        return any(b < a for a, b in pairwise(times))

    studio.eventually(round_again)
    assert "Pause" in studio["#play"].inner_text()
    studio["#play"].click()
    studio["#timeline"].fill("0.5")
    studio.until_code([0.1, 0, 1])


def test_past_the_ends_and_the_shorter_way_round(studio: OpenPage) -> None:
    keyframes(studio, (0, 3, 0), (0.1, -3, 0))
    studio["#beyond"].select_option("0.5")
    timeline = studio["#timeline"]
    assert [float(timeline.get_attribute(end) or 0) for end in ("min", "max")] == [-0.5, 1.5]
    for t in (-0.5, 0.5, 1.5):
        timeline.fill(str(t))
        step = 2 * np.pi - 6
        angle = 3 + t * step
        studio.until_code([0.1 * t, angle if angle < np.pi else angle - 2 * np.pi, 0], 0.01)
    # Slow at keyframes: after a tenth of the time, less than a twentieth of the way.
    studio["#easing"].select_option("soft")
    for t, share in ((0.1, 0.028), (0.5, 0.5), (0.9, 0.972)):
        timeline.fill(str(t))
        studio.eventually(lambda share=share: abs(studio.code[0] - 0.1 * share) < 0.003)
    assert studio.hash["easing"] == "soft"


def test_frames_are_played_as_they_come(studio: OpenPage) -> None:
    keyframes(studio, (-0.2, 0, 0), (0.2, 0, 1))
    held: list[Route] = []

    def hold(route: Route) -> None:
        later = len(route.request.post_data_json["latents"]) == 12 and "12 of 25" in status()
        held.append(route) if later else route.continue_()

    def status() -> str:
        return studio["#path-status"].inner_text()

    def time() -> float:
        return float(studio["#time"].inner_text().removeprefix("t = "))

    studio.page.route("**/vertices?*", hold)
    studio["#play"].click()
    studio.eventually(lambda: bool(held) and time() > 0.3)
    assert "Pause" in studio["#play"].inner_text()
    studio.frames(30)
    assert time() <= 11 / 24 + 0.01, "it shows frames that haven't arrived"
    held[0].continue_()
    studio.eventually(lambda: time() == 1)
    studio.eventually(lambda: "Play" in studio["#play"].inner_text())
    assert status() == ""


def test_frames_that_never_come_are_told_and_can_be_asked_for_again(visit: Visit) -> None:
    studio = visit("#model=with-fine&keys=-0.2,0,0;0.2,0,1", complains=True)
    studio.tab("Path")

    def refuse(route: Route) -> None:
        later = "12 of 25" in studio["#path-status"].inner_text()
        said = '{"type": "urn:shapespace:problem:deadline-passed", "detail": "Too late."}'
        problem = {"status": 504, "content_type": "application/problem+json", "body": said}
        route.fulfill(**problem) if later else route.continue_()

    studio.page.route("**/vertices?*", refuse)
    studio["#play"].click()
    studio.eventually(lambda: "did not finish in time" in studio.messages)
    studio.eventually(lambda: "Play" in studio["#play"].inner_text())
    studio.let_through()
    studio["#play"].click()
    studio.until_code([0.2, 0, 1])


@pytest.mark.parametrize(
    "path",
    [
        "beyond=0.25&easing=soft",
        "show=loop&easing=soft",
        *(pytest.param(some, marks=pytest.mark.long) for some in ("beyond=0", "beyond=0.25")),
    ],
)
def test_a_saved_path_goes_where_the_player_goes(visit: Visit, path: str) -> None:
    codes = "0,3,0;0.1,-2.7,1;-0.1,-2,0.5;0.2,1,0.2"
    studio = visit(f"#model=with-fine&z=0,0,0.7&keys={codes}&{path}")
    studio.tab("Path")
    studio.eventually(lambda: studio["#animation-format option"].count() > 0)
    studio["#animation-format"].select_option("npz")
    with studio.page.expect_download() as download:
        studio["#download-animation"].click()
    latents = np.load(download.value.path())["latents"]
    soft, loop, beyond = "soft" in path, "loop" in path, 0.25 if "0.25" in path else 0.0
    assert len(latents) == (96 if loop else 72 * (1 + 2 * beyond) + 1)
    for frame in (5, 30, 50, 70):
        share = frame / (len(latents) - (not loop))
        studio["#timeline"].fill(str(-beyond + (1 + 2 * beyond) * share))
        # The player's frames are evenly spaced; it shows the code of the nearest, at most 3 / 24 / 2 away.
        studio.until_code(latents[frame], 0.07 if soft else 1e-4)
    at_first = round(beyond / (1 + 2 * beyond) * (len(latents) - 1))
    assert np.allclose(latents[at_first], [0, 3, 0], atol=1e-5)
    pace = np.abs(np.diff(latents[:, 0]))[at_first:]
    assert (pace[0] < 0.1 * pace.max()) == soft, "slow at keyframes only with the soft pace"


def test_keyframes_can_be_visited_reordered_replaced_and_removed(studio: OpenPage) -> None:
    keyframes(studio, (0, 0, 0), (0.1, 0, 0), (0.2, 1, 0))
    items = studio["#keyframes > li"]
    items.nth(2).drag_to(items.nth(0))
    studio.eventually(lambda: studio.hash.get("keys") == "0.2,1,0;0,0,0;0.1,0,0")
    studio.page.keyboard.press("Alt+ArrowRight")  # the dragged keyframe has the focus
    studio.page.keyboard.press("Alt+ArrowRight")
    studio.page.keyboard.press("Alt+ArrowRight")  # it is already the last one
    studio.eventually(lambda: studio.hash.get("keys") == "0,0,0;0.1,0,0;0.2,1,0")
    assert items.nth(2).locator("[data-do=go]").evaluate("b => document.activeElement === b")
    assert studio.messages == ""
    studio.page.get_by_role("button", name="Go to keyframe 1").click()
    studio.until_code([0, 0, 0])
    studio.page.get_by_role("button", name="Take the shape as it is for keyframe 2").click()
    studio.eventually(lambda: studio.hash.get("keys") == "0,0,0;0,0,0;0.2,1,0")
    studio.page.get_by_role("button", name="Remove keyframe 1").click()
    studio.eventually(lambda: studio.hash.get("keys") == "0,0,0;0.2,1,0")
    assert studio["#keyframes > li"].count() == 2


def test_the_strip_shows_each_factor_alone(studio: OpenPage) -> None:
    keyframes(studio, (-0.2, 0, 1), (0.2, 0, 1))
    studio["#draw-strip"].click()
    studio.eventually(lambda: studio["#strip canvas.drawn"].count() == 15)
    assert studio["#strip tbody th"].all_inner_texts() == ["all factors", "size", "form"]
    assert studio["#strip thead th"].all_inner_texts() == ["0.00", "0.25", "0.50", "0.75", "1.00"]
    rows = [[body(studio["#strip tbody"].nth(i).locator("canvas").nth(k)) for k in (0, 4)] for i in range(3)]
    changes = [np.abs(first - last).mean() for first, last in rows]
    assert changes[0] > 1
    assert changes[1] > 1
    assert changes[2] == 0, "this factor doesn't move on this path"
    assert np.abs(rows[2][0] - rows[1][0]).mean() > 1, "and its shape differs from the other factor's"


def test_colours_by_stretch_and_bending(studio: OpenPage) -> None:
    assert studio["#legend"].is_hidden()
    studio.type(0, 0.2)
    studio.until_code([0.2, 0, 0])
    studio.rest()
    studio.tab("Colour")
    plain = studio.picture()
    studio.page.get_by_label("stretch").check()
    studio.until_different(plain, 0.01)
    assert studio["#legend .title"].inner_text().startswith("Stretch")
    average, low, high = numbers(studio)
    assert average == low == high == 20, "the first factor scales all lengths equally"
    studio.page.get_by_label("bending").check()
    studio.eventually(lambda: studio["#legend .title"].inner_text().startswith("Bending"))
    assert max(map(abs, numbers(studio))) < 0.1
    studio.eventually(lambda: studio.hash.get("colour") == "bending")

    studio.tab("Path")
    studio["#add-keyframe"].click()
    studio.tab("Shape")
    studio.type(0, 0.08)
    studio.tab("Colour")
    studio.page.get_by_label("stretch").check()
    studio["#against"].select_option("keyframe 1")
    studio.eventually(lambda: numbers(studio) == [11, -10, -10])
    studio.page.locator("[name=colour][value=none]").check()
    studio.eventually(studio["#legend"].is_hidden)


def numbers(studio: OpenPage) -> list[float]:
    """Average, minimum and maximum in the legend."""
    text = studio["#legend .numbers"].inner_text().replace("−", "-")
    return [float(part) for part in re.findall(r"[-+]?\d+\.?\d*(?:e-?\d+)?", text)]


def test_lengths_and_angles_in_the_page_are_those_of_the_server(studio: OpenPage) -> None:
    from shapespace.coordinates.nric import nric
    from shapespace.mesh.triangle_mesh import TriangleMesh

    script = """async () => {
        const [{ Surface }, api] = await Promise.all([
            import('/page/js/view/surface.js'), import('/page/js/server/api.js')]);
        const model = (await api.models()).find(({ name }) => name === 'with-fine');
        const { faces, vertices } = await api.reference(model, 'coarse');
        const { shapes: [x] } = await api.shapes(model, [[0.1, 1, 0.5]], 'coarse');
        const surface = new Surface(faces, vertices.length / 3);
        const { lengths, angles } = surface.measure(x);
        return [faces, x, lengths, angles].map((a) => Array.from(a)).concat([surface.edges]);
    }"""
    faces, x, lengths, angles, edges = studio.page.evaluate(script)
    mesh = TriangleMesh.from_arrays(np.reshape(x, (-1, 3)), np.reshape(faces, (-1, 3)))
    expected = nric(mesh.vertices, mesh.connectivity)
    pairs = np.sort(np.array(edges)[:, :2], axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    assert np.array_equal(pairs[order], mesh.edges)
    half = mesh.connectivity.edge_count
    assert np.allclose(np.array(lengths)[order], expected[:half], atol=1e-5)
    assert np.allclose(np.array(angles)[order], expected[half:], atol=1e-4)


@pytest.mark.parametrize("loop", [False, True])
def test_codes_along_a_path_are_those_of_the_server(studio: OpenPage, loop: bool) -> None:
    codes = [[0.1, 3, 0], [0.2, -3, 0.5], [0, 0.1, 1], [0.1, -3.1, 1]]
    ends = (0, 1) if loop else (-0.5, 1.25)
    asked = {"keyframes": codes, "frames": 30, "start": ends[0], "stop": ends[1], "loop": loop, "mesh": "coarse"}
    made = httpx.post(f"{studio.url}/v1/models/with-fine/interpolations", json=asked).raise_for_status().json()
    answer = httpx.get(f"{studio.url}{made['links']['npz']}&quality=draft", timeout=60).raise_for_status()
    arrays = np.load(io.BytesIO(answer.content))
    script = """async ([keyframes, times]) => {
        const [{ LatentSpace }, api] = await Promise.all([
            import('/page/js/server/space.js'), import('/page/js/server/api.js')]);
        const model = (await api.models()).find(({ name }) => name === 'with-fine');
        return new LatentSpace(model).along(keyframes, times);
    }"""
    closed = [*codes, codes[0]] if loop else codes
    times = arrays["t"] * (len(closed) - 1)
    assert np.allclose(studio.page.evaluate(script, [closed, times.tolist()]), arrays["latents"], atol=1e-5)


def test_pictures_of_keyframes_differ(studio: OpenPage) -> None:
    keyframes(studio, (-0.2, 0, 0), (0.2, 0, 0))
    first, second = (body(studio["#keyframes canvas"].nth(i))[..., :3] for i in range(2))
    assert difference(first.astype(int), second.astype(int)) > 0.05


def test_a_film_of_a_path_that_changes_before_its_frames_are_there_is_none(visit: Visit) -> None:
    studio = visit("#model=with-fine&keys=-0.2,0,0;0.2,0,1")
    studio.tab("Path")
    held = Hold(studio.page, re.compile("vertices"))
    studio["#film"].click()
    studio.eventually(lambda: any(len(route.request.post_data_json["latents"]) == 12 for route in held.routes))
    studio["#loop"].check()
    held.release()
    studio.frames(3)
    assert studio.messages == ""
    assert "Play" in studio["#play"].inner_text()
