"""Response time of the web page: ``python -m benchmarks.page``, or ``--static`` for the page without a server.

Starts the server with the bundled models and opens its page in headless Chromium, with WebGL in software. With
``--static`` a server of files shows the figure's page of `shapespace page`. The script
in the page measures from the ``input`` event of a slider to the next frame after new pixels were read back from the
canvas. Reading back forces the renderer to finish. The benchmark also prints the transferred bytes of the page, and
the time from a ready server to the first shape, also on a line of 1 MB/s with a latency of 100 ms.
"""

import argparse
import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from playwright.sync_api import Page, sync_playwright

from benchmarks.processes import server
from shapespace.commands.page import page as write_page
from tests.page.conftest import CHROMIUM, FLAGS
from tests.page.studio import slow_down

#: Time from a slider's event to new pixels, in ms.
SLIDE = """async ([k, value]) => {
    const canvas = document.querySelector('#canvas');
    const gl = canvas.getContext('webgl2');
    const slider = document.querySelectorAll('.coordinate input[type=range]')[k];
    const read = () => {
        const pixels = new Uint32Array(gl.drawingBufferWidth * gl.drawingBufferHeight);
        const bytes = new Uint8Array(pixels.buffer);
        gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
        return pixels.filter((_, i) => i % 7 === 0);
    };
    slider.value = value;
    const began = performance.now();
    slider.dispatchEvent(new Event('input', { bubbles: true }));
    for (;;) {
        // The buffer can be read in the task that has drawn it.
        await new Promise((resolve) => {
            canvas.addEventListener('drawn', () => resolve(window.pixels = read()), { once: true });
        });
        if (!window.before || window.pixels.some((value, i) => value !== window.before[i])) break;
    }
    window.before = window.pixels;
    await new Promise(requestAnimationFrame);
    return performance.now() - began;
}"""


def slides(page: Page, count: int) -> list[float]:
    """Return times of moves of one slider to and fro, without the first moves."""
    times = []
    for i in range(count + 3):
        times.append(page.evaluate(SLIDE, [4, 0.5 * (-1) ** i + 0.001 * i]))
        page.wait_for_timeout(60)
    return times[3:]


def first_shape(page: Page, url: str) -> float:
    """Return the seconds from an address to its first shape."""
    page.emulate_media(reduced_motion="reduce")  # without this the shape would move by itself
    began = time.perf_counter()
    page.goto(url, wait_until="commit")
    page.wait_for_selector(".stage[data-shown]", timeout=120_000)
    return time.perf_counter() - began


@contextmanager
def address(arguments: argparse.Namespace) -> Iterator[str]:
    """Start a server; yield the address of the page."""
    if not arguments.static:
        with server(arguments.models) as (client, *_):
            yield str(client.base_url)
        return
    with TemporaryDirectory() as folder:
        write_page(model=str(arguments.models / "figure"), out=Path(folder), force=False)
        with subprocess.Popen(
            [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1"],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as process:
            found = re.search(r"\((http://\S+)\)", process.stdout.readline() if process.stdout else "")
            if found is None:
                raise SystemExit("the server did not start")
            yield found[1]
            process.terminate()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder of bundles")
    parser.add_argument("--count", type=int, default=60, help="moves of a slider")
    parser.add_argument("--static", action="store_true", help="measure the page without a server")
    arguments = parser.parse_args()
    with address(arguments) as url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(120_000)
        weights: dict[str, float] = {}  # by request, without shapes
        devtools = page.context.new_cdp_session(page)
        devtools.send("Network.enable")

        def finished(event: dict[str, Any]) -> None:
            if event["requestId"] in weights:
                weights[event["requestId"]] += event["encodedDataLength"]

        def asked(event: dict[str, Any]) -> None:
            if "/v1/" not in event["request"]["url"]:
                weights[event["requestId"]] = 0.0

        devtools.on("Network.requestWillBeSent", asked)
        devtools.on("Network.loadingFinished", finished)
        first = first_shape(page, url)
        weight = sum(weights.values())
        while page.locator(".end canvas.drawn").count() < page.locator(".end canvas").count():
            page.wait_for_timeout(100)
        times = sorted(slides(page, arguments.count))
        slow = []
        for _ in range(5):
            with browser.new_context(viewport={"width": 1280, "height": 800}) as context:
                slow_down(fresh := context.new_page())
                slow.append(first_shape(fresh, url))
        print(f"First shape {first:.2f} s after the address was entered; the page weighs {weight / 1e6:.2f} MB.")
        print(f"At 1 MB/s and 100 ms latency: {statistics.median(slow):.2f} s, {min(slow):.2f} to {max(slow):.2f}.")
        p50, p95 = statistics.median(times), times[int(0.95 * len(times))]
        print(f"Load of the machine: {os.getloadavg()[0]:.1f}.")
        print(f"Slider to new pixels: median {p50:.0f} ms, 95 % {p95:.0f} ms, of {len(times)} moves.")
        browser.close()


if __name__ == "__main__":
    main()
