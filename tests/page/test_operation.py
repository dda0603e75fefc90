"""The page as a whole: models, errors, a server that stops and starts, accessibility, download size."""

import json
import re
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Route

from shapespace.service.http.problems import KINDS
from tests.page.conftest import Open, Visit
from tests.page.studio import OpenPage, difference
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, Start
from tests.service.watching import free_port

AXE = ROOT / "tests" / "node_modules" / "axe-core" / "axe.min.js"


def test_the_models_and_their_cards(studio: OpenPage) -> None:
    assert studio["#model option"].all_inner_texts() == ["Figure", "Small torus"]
    studio["#about"].click()
    studio.eventually(studio["#card"].is_visible)
    card = studio["#card"].inner_text()
    for fact in (
        "A torus for tests.",
        "with-fine · version 1 · CC0-1.0",
        "This model",
        "64 vertices",
        "Digest",
        "shapes that training has not seen",
        "3\u00a0%",
        "5\u00a0%",
        "away from the nearest training shape",
        "With as many principal components",
    ):
        assert fact in card
    bars = studio["#card .bar"].evaluate_all("bars => bars.map((bar) => bar.getBoundingClientRect().width)")
    assert bars[0] / bars[1] == pytest.approx(3 / 5, rel=0.02)
    studio.page.keyboard.press("Escape")
    small = studio.picture()
    studio["#model"].select_option("Figure")
    studio.eventually(lambda: studio.hash.get("model") == "figure" and studio[".factor"].count() > 3)
    studio.until_different(small, 0.02)
    assert studio["#undo"].is_disabled()
    assert "Figure" in studio.page.title()
    studio["#about"].click()
    studio.eventually(lambda: "A mannequin" in studio["#card"].inner_text())
    card = studio["#card"].inner_text()
    assert "99.997\u00a0%" in card
    assert "100\u00a0%" not in card, "what is nearly all is not all"
    assert "_" not in card, "names in words"


def test_back_goes_to_the_shape_before_and_to_the_model_before(window: Open) -> None:
    studio = window().open("#model=with-fine&z=0,0,0.5")
    start = studio.picture()
    studio.slide(0, 0.3)
    studio.until_code([0.3, 0, 0.5])
    studio.slide(1, -0.2)
    studio.until_code([0.3, -0.2, 0.5])
    studio["#wireframe"].click()
    studio.eventually(lambda: studio.hash.get("show"))
    studio["#model"].select_option("Figure")
    studio.eventually(lambda: studio.hash.get("model") == "figure" and len(studio.code) == 20)

    studio.page.go_back()
    studio.eventually(lambda: studio.hash.get("model") == "with-fine" and studio.code == [0.3, -0.2, 0.5])
    studio.eventually(lambda: "Small torus" in studio.page.title())  # the address changes before the model is there
    studio.rest()
    assert studio["#wireframe"].get_attribute("aria-pressed") == "true", "shown as it was then"
    studio.page.go_back()
    studio.until_code([0.3, 0, 0.5])
    studio.eventually(studio["#undo"].is_enabled)  # the address changes before the shape
    studio.page.go_back()
    studio.until_code([0, 0, 0.5])
    studio.rest()
    studio.eventually(lambda: difference(studio.picture(), start) < 0.002)
    studio.page.go_forward()
    studio.until_code([0.3, 0, 0.5])


def test_errors_of_the_server_are_said_in_the_page(visit: Visit) -> None:
    studio = visit(complains=True)
    before = studio.picture()
    refusal = json.dumps({"type": "urn:shapespace:problem:not-finite", "detail": "Send finite numbers for latents."})

    def refuse(route: Route) -> None:
        is_shown = '"fine"' in (route.request.post_data or "")  # the small pictures are coarse
        route.fulfill(status=422, body=refusal) if is_shown else route.continue_()

    studio.page.route("**/vertices*", refuse)
    studio.type(0, 0.12)
    message = studio.eventually(lambda: studio["#messages .error"].first.inner_text() or None)
    assert "A number is too large for a shape" in message
    assert "latents" not in message, "the server's words are for programs"
    assert studio["#messages"].get_attribute("aria-live") == "polite"
    # The shape of the code before stays, in grey, and nothing vouches for it.
    assert "stale" in (studio[".stage"].get_attribute("class") or "")
    assert studio["#diagnostics summary"].inner_text() == "No shape for these values"
    assert studio["#busy"].is_hidden()
    studio["#messages .error button"].first.click()
    assert studio["#messages .error"].count() == 0
    studio.let_through()
    studio.type(0, 0.1)
    studio.rest()
    studio.until_different(before)
    assert "stale" not in (studio[".stage"].get_attribute("class") or "")


def test_every_problem_of_the_server_has_words_for_people(studio: OpenPage) -> None:
    texts = studio.page.evaluate("async () => (await import('/page/js/server/problems.js')).TEXTS")
    assert {*texts} == {*KINDS}
    for kind, text in texts.items():
        assert re.fullmatch(r"[^?=&{}`/]+\.", text), kind
        assert not re.search(r"JSON|HTTP|Content-Type|Accept|parameter|header|latent|\bSend\b", text), kind


@pytest.fixture(scope="module")
def torus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small torus alone, with which a server starts seconds faster."""
    models = tmp_path_factory.mktemp("torus")
    write_bundle(models, "with-fine", fine=True)
    return models


def test_a_server_that_went_away_and_comes_back(window: Open, start: Start, torus: Path) -> None:
    port = free_port()
    server = start(torus, port=port)
    studio = window(server.url, complains=True).open()
    before = studio.picture()
    server.stop()
    studio.slide(0, 0.15)
    studio.eventually(lambda: "does not answer" in studio.messages)
    studio.slide(0, -0.15)
    start(torus, port=port)
    studio.eventually(lambda: "is back" in studio.messages and "does not answer" not in studio.messages)
    studio.rest()
    studio.until_code([-0.15, 0, 0], 1e-3)
    assert covered(studio.picture()) < 0.9 * covered(before)


def covered(picture: np.ndarray) -> float:
    """Share of pixels that the shape covers."""
    return float((np.abs(picture - picture[0, 0]).max(axis=2) > 40).mean())


def test_a_server_with_a_key(window: Open, start: Start, torus: Path) -> None:
    server = start(torus, api_key="open-sesame")
    studio = window(server.url, complains=True)
    studio.page.goto(server.url)
    studio.eventually(studio["#key"].is_visible)
    studio.page.evaluate(AXE.read_text())
    check(studio, "key")
    studio["#key input"].fill("open-sesame")
    studio["#key input"].press("Enter")
    studio.rest()
    assert studio["#key"].is_hidden()


def test_the_page_stays_with_the_version_that_it_listed(start: Start, window: Open, tmp_path: Path) -> None:
    for version in ("1", "2"):
        write_bundle(tmp_path, "with-fine", version, fine=True)
    # Half of the codes would get version 2, while the card is of version 1.
    studio = window(start(tmp_path, default_versions="with-fine=1:51,2:49").url)
    answered: list[tuple[str, str]] = []
    studio.page.on("response", lambda got: answered.append((got.url, got.headers.get("model-version", ""))))
    studio.open()
    before = studio.picture()
    studio.slide(0, 0.15)
    studio.until_different(before)
    for value in (0.01, 0.02, 0.03, 0.04, 0.05):
        studio.type(0, value)
        studio.rest()
    asked = [version for url, version in answered if "/v1/models/with-fine" in url]
    assert len(asked) > 8
    assert {*asked} == {"1"}


def test_no_model_is_said(window: Open, start: Start, tmp_path: Path) -> None:
    (tmp_path / "none").mkdir()
    studio = window(start(tmp_path / "none").url, complains=True)
    studio.page.goto(studio.url)
    studio.eventually(lambda: "No model is served" in studio.messages)


LOOKS: dict[str, dict[str, Any]] = {
    "light": {},
    "dark phone": {
        "viewport": {"width": 390, "height": 844},
        "has_touch": True,
        "is_mobile": True,
        "color_scheme": "dark",
    },
}


@pytest.mark.parametrize("look", LOOKS)
def test_axe_finds_no_fault(window: Open, look: str) -> None:
    studio = window(**LOOKS[look]).open()
    studio.page.evaluate(AXE.read_text())
    studio["#to-look"].click()
    studio.eventually(studio["#look"].is_visible)
    check(studio, "look")
    studio.page.keyboard.press("Escape")
    if "phone" in look:
        studio["#to-more"].click()
        check(studio, "menu")
    studio["#about"].click()
    studio.eventually(studio["#card"].is_visible)
    check(studio, "card")
    studio.page.keyboard.press("Escape")
    for tab in ("Shape", "Path", "Colour", "Files"):
        studio.tab(tab)
        if tab == "Shape":
            studio["#keep-shape"].click()
            studio["#keep-shape"].click()
            studio.page.get_by_role("button", name="Compare with Shape 1").click()
            studio.eventually(studio["#blend"].is_visible)
        if tab == "Path":
            studio["#add-keyframe"].click()
            studio["#add-keyframe"].click()
            studio["#draw-strip"].click()
            studio.eventually(lambda: studio["#strip canvas.drawn"].count() == 15)
        if tab == "Colour":
            studio.page.get_by_label("stretch").check()
            studio.eventually(studio["#legend"].is_visible)
        if tab == "Files":
            scan = httpx.get(f"{studio.url}/v1/models/with-fine/mesh?latent=0.1,0,0.5&format=obj").content
            studio["#mesh-file"].set_input_files({"name": "a.obj", "mimeType": "model/obj", "buffer": scan})
            studio.eventually(lambda: "The shape of a.obj" in studio["#verdict h2"].inner_text())
        check(studio, tab)


def check(studio: OpenPage, where: str) -> None:
    found = studio.page.evaluate("async () => (await axe.run()).violations")
    serious = [(fault["id"], fault["impact"], fault["nodes"][0]["html"]) for fault in found]
    assert serious == [], where


def test_everything_is_reached_by_keyboard(studio: OpenPage) -> None:
    def focused() -> str:
        return studio.page.evaluate("document.activeElement.id || document.activeElement.dataset.do || ''")

    reached = set()
    studio.slide(2, 0.5)
    studio["#canvas"].press("ArrowLeft")  # what is back at its start cannot be reset
    studio.eventually(studio["#reset-view"].is_visible)
    studio["#model"].focus()
    for _ in range(60):
        reached.add(focused())
        studio.page.keyboard.press("Tab")
    assert {
        "model",
        "about",
        "random",
        "seed",
        "share",
        "theme",
        "canvas",
        "fine",
        "wireframe",
        "normals",
        "pull",
    } <= reached
    assert {"reset-view", "to-shape", "reset-all", "z0", "lock", "reset", "z2"} <= reached
    studio["#to-shape"].focus()
    studio.page.keyboard.press("ArrowRight")
    assert studio["#tab-path"].is_visible()
    assert focused() == "to-path"
    studio.page.keyboard.press("End")
    assert studio["#tab-files"].is_visible()


def test_the_page_is_light_and_all_from_here(window: Open, server: Server) -> None:
    studio = window().open()
    needed = {address for address in studio.addresses if "/v1/" not in address and "/v2/" not in address}
    assert any("three.core" in address for address in needed)
    weight = 0
    with httpx.Client(headers={"Accept-Encoding": "gzip"}) as client:
        for address in needed:
            with client.stream("GET", address) as answer:
                assert answer.status_code == 200, address
                weight += sum(map(len, answer.iter_raw())) + len(str(answer.headers))
    assert weight <= 1.5e6

    with httpx.Client(base_url=server.url) as client:
        page = client.get("/")
        policy = page.headers["Content-Security-Policy"]
        assert "default-src 'self'" in policy
        assert "unsafe" not in policy
        assert not re.findall(r"""(?:src|href)=["'](?:https?:)?//""", page.text)
        script = client.get("/page/js/main.js")
        again = client.get("/page/js/main.js", headers={"If-None-Match": script.headers["ETag"]})
        assert again.status_code == 304
        assert client.get("/page/js/none.js").status_code == 404
        assert client.get("/page/%2e%2e/app.py").status_code == 404


def test_pixels_stay_when_nothing_happens(studio: OpenPage) -> None:
    first = studio.picture()
    studio.frames(10)
    assert difference(first, studio.picture()) == 0
