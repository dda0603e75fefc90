"""The page in a real browser, as a user sees and operates it."""

from __future__ import annotations

import base64
import io
import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar
from urllib.parse import parse_qs, urlsplit

import numpy as np
from PIL import Image
from playwright.sync_api import CDPSession, ConsoleMessage, Error, Locator, Page, Request, Route

T = TypeVar("T")
PATIENCE = 120.0  # seconds; the machine may be busy with other things

#: Undoes what an address does not say: what is open, chosen, kept or written.
RESET = """() => {
    const all = (selector) => document.querySelectorAll(selector);
    for (const dialog of all('dialog[open]')) dialog.close();
    for (const popover of all(':popover-open')) popover.hidePopover();
    const pressed = '#pull[aria-pressed=true], #spin[aria-pressed=true]';
    for (const button of all(`#to-shape, #messages button, ${pressed}`)) button.click();
    for (const details of all('#diagnostics, #verdict details')) details.open = false;
    for (const menu of all('#distribution, #read-as, #format, #language, .video-format')) menu.selectedIndex = 0;
    for (const menu of all('#format, #language')) menu.dispatchEvent(new Event('change'));
    for (const input of all('#seed, #path-name, #turntable-seconds')) input.value = input.defaultValue;
    document.querySelector('#own-scale').checked = false;
    document.activeElement.blur();
    localStorage.clear();
    sessionStorage.clear();
}"""


#: Whether the full shape, no draft, is drawn, on the fine mesh if the model has one.
RESTS = """() => {
    const [stage, fine] = ['.stage', '#fine'].map((selector) => document.querySelector(selector));
    if (!fine) return false;
    const mesh = fine.disabled || fine.ariaPressed === 'false' ? 'coarse' : 'fine';
    const { quality, shown } = stage.dataset;
    return shown === mesh && quality === 'full' && stage.ariaBusy !== 'true';
}"""

#: Holds the timer that ends a movement by keys, of `REST` in hand.js.
HOLD_KEYS = """() => {
    window.timed = window.setTimeout;
    window.setTimeout = (work, time) => window.timed(work, time === 700 ? 1e8 : time);
}"""


class Hold:
    """Holds the requests to addresses that match a pattern, until `release`; `routes` has those that are held."""

    def __init__(self, page: Page, address: str | re.Pattern[str]) -> None:
        self.routes: list[Route] = []
        self._released = False
        page.route(address, lambda route: route.continue_() if self._released else self.routes.append(route))

    def release(self) -> None:
        self._released = True
        for route in self.routes:
            route.continue_()


class OpenPage:
    """An open page, with its errors and requests.

    Playwright's own way to wait for conditions needs `eval`, which the page's content security policy
    forbids.

    Attributes:
        complaints: errors in the console, and uncaught exceptions.
        foreign: requested addresses on other hosts.
        asked: bodies of the requests for vertices.
    """

    def __init__(self, page: Page, url: str) -> None:
        self.page, self.url = page, url
        self.complaints: list[str] = []
        self.foreign: list[str] = []
        self.addresses: list[str] = []
        self.asked: list[dict[str, Any]] = []
        page.on("console", self._said_in_console)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", self._requested)
        page.set_default_timeout(1000 * PATIENCE)
        self._devtools: CDPSession | None = None

    def _said_in_console(self, message: ConsoleMessage) -> None:
        # In tests the browser reads each picture back from WebGL, and warns of the time.
        if message.type in {"error", "warning"} and "GPU stall due to ReadPixels" not in message.text:
            self.complaints.append(message.text)

    def _requested(self, request: Request) -> None:
        self.addresses.append(request.url)
        if not request.url.startswith((self.url, "blob:", "data:")):
            self.foreign.append(request.url)
        if urlsplit(request.url).path.endswith("/vertices"):
            self.asked.append(request.post_data_json)

    def eventually(self, what: Callable[[], T], patience: float = PATIENCE) -> T:
        """The first value of `what` that is neither None nor False."""
        end = time.monotonic() + patience
        while (value := what()) is None or value is False:
            assert time.monotonic() < end, f"not true in time: {self._said()}"
            self.page.wait_for_timeout(30)  # also processes the browser's events
        return value

    def _said(self) -> list[str]:
        return [*self.complaints, *self["#messages, #verdict"].all_text_contents()]

    def let_through(self) -> None:
        """Leave all requests to the server again; errors of handlers that still run are ignored.

        Playwright's `unroute` would raise them: it lets a request pass that a handler is about to answer.
        """
        self.page.unroute_all(behavior="ignoreErrors")

    def open(self, hash: str = "#model=with-fine") -> OpenPage:
        """Load the page and wait until its full shape is drawn."""
        self.page.goto(f"{self.url}/{hash}")
        self.rest()
        return self

    def visit(self, hash: str, size: tuple[int, int]) -> OpenPage:
        """Show an address in a window of a size until its full shape is drawn; on a loaded page as if it were new."""
        width, height = size
        self.page.set_viewport_size({"width": width, "height": height})
        if self.page.url == "about:blank":
            return self.open(hash)
        self.let_through()
        self.page.mouse.move(0, 0)
        self.page.evaluate(RESET)
        # All that belongs to a model is made anew with the next one.
        name = parse_qs(hash.lstrip("#"))["model"][0]
        for address in ("#model=figure" if name == "with-fine" else "#model=with-fine", hash):
            model = parse_qs(address.lstrip("#"))["model"][0]
            self.page.evaluate("hash => { location.hash = hash; }", address)
            self.eventually(lambda model=model: self["#model"].input_value() == model)  # type: ignore[misc]
        self.rest()
        for seen in (self.complaints, self.foreign, self.addresses, self.asked):
            seen.clear()
        return self

    def require_calm(self, complains: bool) -> None:
        """Check that the page had no errors, unless it `complains`, and sent no requests to another host."""
        assert not self.foreign, self.foreign
        assert complains or not self.complaints, self.complaints

    def rest(self) -> None:
        """Wait until the full shape, no draft, is drawn, on the fine mesh if the model has one."""

        def rests() -> bool:
            try:
                return bool(self.page.evaluate(RESTS))
            except Error:  # the page is being loaded
                if self.page.is_closed():
                    raise
                return False

        self.eventually(rests)

    @contextmanager
    def keys_in_a_row(self) -> Iterator[None]:
        """Keys that are pressed inside are one movement, however slowly a busy machine presses them."""
        self.page.evaluate(HOLD_KEYS)
        yield
        self.page.evaluate("() => { window.setTimeout = window.timed; }")

    def frames(self, count: int) -> None:
        """Wait until the browser has drawn some frames: what was to happen has happened by then."""
        script = "async (n) => { for (; n; n -= 1) await new Promise(requestAnimationFrame); }"
        self.page.evaluate(script, count)

    @property
    def shown(self) -> str | None:
        """Which mesh is drawn, fine or coarse."""
        return self.page.locator(".stage").get_attribute("data-shown")

    @property
    def quality(self) -> str | None:
        """Whether the drawn shape is a draft or full; None after a change of the code, until a shape is drawn."""
        return self.page.locator(".stage").get_attribute("data-quality")

    @property
    def waits(self) -> bool:
        """Whether the drawn shape, if any, is marked as that of another code."""
        return self.page.locator(".stage").get_attribute("aria-busy") == "true"

    def __getitem__(self, selector: str) -> Locator:
        return self.page.locator(selector)

    @property
    def hash(self) -> dict[str, str]:
        """The page's state, from its address."""
        return {key: values[0] for key, values in parse_qs(urlsplit(self.page.url).fragment).items()}

    @property
    def code(self) -> list[float]:
        """The code in the page's address."""
        return [float(part) for part in self.hash["z"].split(",")] if "z" in self.hash else []

    def until_code(self, expected: Any, tolerance: float = 1e-4) -> None:
        """Wait until the address has this code."""
        try:
            self.eventually(
                lambda: len(self.code) == len(expected) and np.allclose(self.code, expected, atol=tolerance)
            )
        except AssertionError:
            raise AssertionError(f"the code is {self.code}, not {expected}") from None

    def coordinate(self, k: int) -> Locator:
        """The row of a coordinate; unfolds its factor."""
        row = self.page.locator(".coordinate").nth(k)
        row.evaluate("row => { row.closest('details').open = true; }")
        return row

    def slide(self, k: int, value: float) -> None:
        """Drag a slider to a value and release it."""
        script = """(slider, value) => {
            slider.dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}));
            slider.value = value;
            slider.dispatchEvent(new Event('input', {bubbles: true}));
            slider.dispatchEvent(new PointerEvent('pointerup', {bubbles: true}));
        }"""
        self.coordinate(k).locator("input[type=range]").evaluate(script, value)

    def type(self, k: int, value: float) -> None:
        """Type a number into a coordinate's box."""
        self.coordinate(k).locator("input[type=number]").fill(str(value))

    def tab(self, name: str) -> None:
        """Open one of the panel's tabs."""
        self.page.get_by_role("tab", name=name).click()

    def picture(self) -> np.ndarray:
        """Pixels (h, w, 3) of the middle of the stage, without the buttons and text around it."""
        box = self.page.locator("#canvas").bounding_box()
        assert box
        clip = {"x": box["x"], "y": box["y"] + 60, "width": box["width"], "height": box["height"] - 110, "scale": 1}
        # Five times as fast as Playwright's own screenshots.
        self._devtools = self._devtools or self.page.context.new_cdp_session(self.page)
        shot = self._devtools.send("Page.captureScreenshot", {"clip": clip, "optimizeForSpeed": True})
        return pixels(base64.b64decode(shot["data"]))

    def until_different(self, before: np.ndarray, share: float = 0.002) -> np.ndarray:
        """Wait until the picture differs from another and shows the shape of the code, and return it."""

        def changed() -> np.ndarray | None:
            now = self.picture()
            return now if difference(before, now) > share and not self.waits else None

        return self.eventually(changed)

    @property
    def messages(self) -> str:
        """The page's messages to the user, including those no longer visible."""
        return self.page.locator("#messages").text_content() or ""


def slow_down(page: Page) -> None:
    """Give a page a line of 1 MB/s with a latency of 100 ms."""
    line = {"offline": False, "latency": 100, "downloadThroughput": 1e6, "uploadThroughput": 1e6}
    page.context.new_cdp_session(page).send("Network.emulateNetworkConditions", line)


def pixels(png: bytes) -> np.ndarray:
    """Pixels (h, w, 3) of a PNG file."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def difference(a: np.ndarray, b: np.ndarray) -> float:
    """Share of pixels in which two pictures differ visibly."""
    return float((np.abs(a - b).max(axis=2) > 12).mean())


def body(canvas: Locator) -> np.ndarray:
    """Pixels (h, w, 4) of a small picture."""
    script = """c => JSON.stringify(Array.from(c.getContext('2d').getImageData(0, 0, c.width, c.height).data))"""
    size = canvas.evaluate("c => [c.height, c.width]")
    return np.array(json.loads(canvas.evaluate(script))).reshape(*size, 4)
