"""Sharing what the page shows: pictures, videos, and frames in other pages."""

import base64
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from threading import Thread

import httpx
import numpy as np
import pytest
from playwright.sync_api import Page

from tests.page.conftest import Open
from tests.page.studio import OpenPage, difference, pixels
from tests.service.conftest import Start

#: A script that returns pictures of a video at nine times from its beginning to its end, as PNG.
STILLS = """async (content) => {
    const video = document.createElement('video');
    const next = (name) => new Promise((resolve, reject) => {
        video.addEventListener(name, resolve, { once: true });
        const failed = () => reject(new Error(`${video.error.code}: ${video.error.message}`));
        video.addEventListener('error', failed, { once: true });
    });
    video.muted = true;
    video.src = `data:video/webm;base64,${content}`;
    await next('loadeddata');
    video.currentTime = 1e6; // what is recorded doesn't say how long it is
    await next('seeked');
    const { currentTime: end, videoWidth, videoHeight } = video;
    const canvas = Object.assign(document.createElement('canvas'), { width: videoWidth, height: videoHeight });
    const stills = [];
    for (let eighth = 0; eighth <= 8; eighth += 1) {
        video.currentTime = (end * eighth) / 8;
        await next('seeked');
        canvas.getContext('2d').drawImage(video, 0, 0);
        stills.push(canvas.toDataURL('image/png').split(',')[1]);
    }
    return [end, ...stills];
}"""


def kept(studio: OpenPage, button: str) -> tuple[str, bytes]:
    """Name and content of the file that a button downloads."""
    with studio.page.expect_download() as download:
        studio[button].click()
    return download.value.suggested_filename, Path(download.value.path()).read_bytes()


def stills(page: Page, video: bytes) -> tuple[float, list[np.ndarray]]:
    """The length of a video in seconds, and its pictures at nine times from its beginning to its end."""
    end, *pictures = page.evaluate(STILLS, base64.b64encode(video).decode())
    return end, [pixels(base64.b64decode(picture)) for picture in pictures]


def changes(pictures: list[np.ndarray], least: float) -> int:
    """How many successive pictures differ; a busy machine records few pictures in a second."""
    return sum(difference(one, other) > least for one, other in pairwise(pictures))


@pytest.mark.long
def test_a_picture_a_turntable_and_the_path_as_a_video(window: Open) -> None:
    studio = window().open("#model=with-fine&z=0,0,0.5&keys=-0.2,0,0;0.2,0,1&seconds=2")
    studio.tab("Files")
    seen = studio.picture()
    name, content = kept(studio, "#picture")
    assert name == "with-fine.png"
    picture = pixels(content)
    assert list(picture.shape[:2]) == studio["#canvas"].evaluate("c => [c.height, c.width]")
    assert difference(picture[60 : 60 + len(seen)], seen) < 0.05, "as on the page, with background"

    plain = window().page  # a page without content security policy
    plain.goto("about:blank")
    studio[".video-format"].first.select_option("webm")
    studio["#turntable-seconds"].fill("5")  # long enough for a busy machine to record some of it
    name, content = kept(studio, "#turntable")
    assert name == "with-fine-turntable.webm"
    seconds, pictures = stills(plain, content)
    assert 0 < seconds < 15
    assert changes(pictures, 0.02) >= 2, "the turntable must move"
    studio["#messages button:visible"].first.click()
    studio.eventually(lambda: difference(studio.picture(), seen) < 0.001)
    assert "view" not in studio.hash

    studio.tab("Path")
    assert studio["#seconds"].input_value() == "2"
    name, content = kept(studio, "#film")
    assert name == "with-fine-animation.webm"
    seconds, pictures = stills(plain, content)
    assert 0 < seconds < 10
    assert changes(pictures, 0.01) >= 1
    assert "The video is saved" in studio.messages
    studio.until_code([0.2, 0, 1])
    studio.rest()

    studio[".video-format"].last.select_option("mp4")
    name, content = kept(studio, "#film")
    assert name == "with-fine-animation.mp4"
    assert content[4:8] == b"ftyp"
    assert b"avc1" in content
    studio.until_code([0.2, 0, 1])


def test_a_browser_that_records_no_pictures_keeps_no_empty_video(window: Open) -> None:
    studio = window().open("#model=with-fine")
    studio.page.evaluate(
        "() => { const { captureStream } = HTMLCanvasElement.prototype;"
        "HTMLCanvasElement.prototype.captureStream ="
        " (rate) => captureStream.call(document.createElement('canvas'), rate); }"
    )
    studio.tab("Files")
    studio["#turntable-seconds"].fill("1")
    studio["#turntable"].click()
    studio.eventually(lambda: "This browser records no pictures of the shape." in studio.messages, 30)
    assert "saved" not in studio.messages


def test_a_phone_with_ar_gets_the_shape_as_usdz(window: Open) -> None:
    studio = window()
    studio.page.add_init_script(
        "const { supports } = DOMTokenList.prototype;"
        "DOMTokenList.prototype.supports = function (word) { return word === 'ar' || supports.call(this, word); };"
    )
    studio.open("#model=with-fine&z=0.1,1,0.5")
    studio.tab("Files")
    link = studio["#ar"]
    studio.eventually(link.is_visible)
    assert link.get_attribute("rel") == "ar"
    # iOS opens its viewer only from a link whose only child is a picture.
    assert link.evaluate("a => [...a.childNodes].map((child) => child.nodeName)") == ["IMG"]
    answer = httpx.get(link.evaluate("a => a.href"), timeout=60)
    assert answer.headers["content-type"] == "model/vnd.usdz+zip"
    assert "latent=0.1%2C1%2C0.5" in str(answer.url)
    assert answer.content.startswith(b"PK")


def test_no_link_to_ar_elsewhere(studio: OpenPage) -> None:
    studio.tab("Files")
    assert studio["#ar"].is_hidden()
    assert not any("usdz" in address for address in studio.addresses)


@pytest.fixture
def theirs(tmp_path: Path) -> Iterator[str]:
    """The origin of another server, which serves a folder."""
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_the_viewer_in_a_page_of_another_origin(
    window: Open, start: Start, models: Path, theirs: str, tmp_path: Path
) -> None:
    studio = window().open("#model=with-fine&z=0.1,1,0.5")
    studio["#canvas"].press("ArrowRight")
    view = studio.eventually(lambda: studio.hash.get("view"))
    studio.tab("Files")
    studio["#language"].select_option("a frame in a page")
    code = studio["#code"].text_content() or ""
    server = start(models, embed_origins=theirs)
    policies = [
        httpx.get(f"{url}/{query}").headers["Content-Security-Policy"].rpartition("frame-ancestors ")[2]
        for url in (studio.url, server.url)
        for query in ("", "?embed")
    ]
    assert policies == ["'none'", "'none'", "'none'", theirs]

    (tmp_path / "index.html").write_text(
        f"<!doctype html><title>Theirs</title><link rel=icon href=data:,>{code.replace(studio.url, server.url)}"
        "<p style='height: 200vh'>"
    )
    other = window(theirs)
    other.page.goto(theirs)
    frame = other.page.frame_locator("iframe")
    other.eventually(lambda: frame.locator(".stage[data-quality=full]").count() == 1)
    for name in ("header", ".panel", ".tools", ".status"):
        assert frame.locator(name).is_hidden(), name
    whole = frame.locator("#whole")
    other.eventually(lambda: (whole.get_attribute("href") or "").endswith(f"/#model=with-fine&z=0.1,1,0.5&view={view}"))
    picture = pixels(other.page.locator("iframe").screenshot())
    shown = np.abs(picture - picture[5, 5]).max(axis=2) > 60
    assert np.ptp(np.flatnonzero(shown[:, 10:-10].any(axis=1))) > 0.4 * len(picture)
    # The wheel over the view scrolls the page around it.
    other.page.locator("iframe").hover()
    other.page.mouse.wheel(0, 120)
    other.eventually(lambda: other.page.evaluate("scrollY") > 0)
    assert all(address.startswith(server.url) for address in other.foreign)
    other.foreign.clear()
