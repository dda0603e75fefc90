"""What is seen until the scripts and the first shape have arrived."""

import re

import numpy as np

from tests.page.conftest import Open
from tests.page.studio import Hold, slow_down

#: Scripts that arrive while another does.
AHEAD = ("first.js", "three.module.min.js", "three.core.min.js", "OrbitControls.js")


def test_a_drawing_and_a_ring_until_the_scripts_arrive_and_no_alarm(window: Open) -> None:
    studio = window()
    held = Hold(studio.page, "**/page/main.js")
    answered: list[str] = []
    studio.page.on("requestfinished", lambda request: answered.append(request.url))
    studio.page.goto(f"{studio.url}/#model=figure", wait_until="commit")
    # The answers for the first shape come beside the scripts, and no script waits for another that names it.
    for call in (
        "/v1/models$",
        "figure/mesh",
        "figure/vertices",
        "poster/figure.svg",
        *(f"/{name}$" for name in AHEAD),
    ):
        studio.eventually(lambda call=call: any(re.search(call, url) for url in answered))  # type: ignore[misc]
    assert studio["#without"].is_hidden()
    assert studio["#busy"].is_visible()
    assert studio.waits
    studio.eventually(lambda: height(studio.picture()) > 0.7)  # the drawing fills the stage
    assert studio["#random"].evaluate("e => e.closest('[inert]') !== null")
    asked = list(studio.asked)
    held.release()
    studio.rest()
    assert studio["#poster"].is_hidden()
    assert studio["#busy"].is_hidden()
    assert not studio.waits
    # The first draft is not requested again.
    assert [body for body in studio.asked if body == asked[0]] == asked
    scripts = [address.rpartition("/")[2] for address in studio.addresses if address.endswith(".js")]
    assert sorted(scripts) == sorted([*AHEAD, "main.js"])


def height(picture: np.ndarray) -> float:
    """Share of the height of a picture that is drawn on."""
    ink = (np.abs(picture - picture[0, 0]).max(axis=2) > 40).any(axis=1)
    return float(np.ptp(np.flatnonzero(ink)) / len(picture)) if ink.any() else 0.0


#: Notes whether a notice was seen at any time before the first shape.
WATCH = """
window.seen = new Set();
const watch = () => {
    for (const id of ['without', 'lost']) {
        if (document.getElementById(id)?.checkVisibility()) window.seen.add(id);
    }
    if (!document.querySelector('.stage')?.dataset.shown) requestAnimationFrame(watch);
};
watch();
"""


def test_on_a_slow_line_nothing_is_said_until_the_shape_is_there(window: Open) -> None:
    studio = window()
    studio.page.add_init_script(f"{{ {WATCH} }}")
    slow_down(studio.page)
    studio.open("#model=figure")
    assert studio.page.evaluate("[...window.seen]") == []
    assert studio.messages == ""


def test_a_script_that_does_not_arrive_is_told_with_a_way_out(window: Open) -> None:
    studio = window(complains=True)
    studio.page.route("**/page/main.js", lambda route: route.abort())
    studio.page.goto(f"{studio.url}/#model=with-fine&z=0.1,0,0")
    studio.eventually(studio["#lost"].is_visible)
    assert studio["#without"].is_hidden()
    assert studio["main"].is_hidden()
    studio.let_through()
    studio["#lost a"].click()
    studio.rest()
    assert studio.code == [0.1, 0, 0]
    assert studio["#lost"].is_hidden()


def test_the_first_shape_of_an_address_is_asked_for_once(window: Open) -> None:
    studio = window().open("#model=with-fine&z=0.1,1,0.5")
    first = [body for body in studio.asked if body["quality"] == "draft" and body["mesh"] == "coarse"]
    assert [body["latents"] for body in first[:1]] == [[[0.1, 1, 0.5]]]
    assert first.count(first[0]) == 1
    assert sum("mesh=coarse" in address for address in studio.addresses) == 1
    assert sum(address.endswith("/v1/models") for address in studio.addresses) == 1
