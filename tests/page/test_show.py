"""Sharing what the page shows: pictures, videos, and frames in other pages."""

import base64
import io
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from threading import Thread

import httpx
import numpy as np
import pytest
from PIL import Image, ImageSequence
from playwright.sync_api import Page

from tests.page.conftest import Open, Visit
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
    studio["#tab-files .video-format"].select_option("webm")
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

    studio["#tab-path .video-format"].select_option("mp4")
    name, content = kept(studio, "#film")
    assert name == "with-fine-animation.mp4"
    assert content[4:8] == b"ftyp"
    assert b"avc1" in content
    studio.until_code([0.2, 0, 1])


def test_a_gif_moves_as_long_as_the_path(visit: Visit) -> None:
    studio = visit("#model=with-fine&z=0,0,0.5&keys=-0.2,0,0;0.2,0,1&seconds=0.7")
    seen = studio.picture()
    studio.tab("Path")
    studio[".video-format"].first.evaluate("menu => { menu.value = 'gif'; menu.dispatchEvent(new Event('change')); }")
    name, content = kept(studio, "#film")
    assert name == "with-fine-animation.gif"
    with Image.open(io.BytesIO(content)) as gif:
        pictures = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(gif)]
        assert gif.info["loop"] == 0, "for ever"
        assert len(pictures) * gif.info["duration"] == pytest.approx(700, abs=70)
    wide, high = studio["#canvas"].evaluate("c => [c.width, c.height]")
    assert pictures[0].shape[:2] == (round(480 * high / wide), 480) if wide > high else (480, round(480 * wide / high))
    assert changes(pictures, 0.003) > len(pictures) / 2
    background = np.median(pictures[0][:5], axis=(0, 1)) - np.median(seen[:5], axis=(0, 1))
    assert np.abs(background).max() < 12, "as on the page"
    studio.eventually(lambda: "The GIF is saved" in studio.messages)


#: A headset with one eye, which draws to the canvas.
HEADSET = """
const modes = ['immersive-vr'];
class Session extends EventTarget {
    renderState = {};
    inputSources = [];
    updateRenderState(state) { Object.assign(this.renderState, state); }
    async requestReferenceSpace() { return {}; }
    requestAnimationFrame(draw) {
        return requestAnimationFrame((time) => this.ended || draw(time, { session: this, getViewerPose: () => pose }));
    }
    cancelAnimationFrame(id) { cancelAnimationFrame(id); }
    async end() {
        this.ended = true;
        this.dispatchEvent(new Event('end'));
    }
}
const height = 1.2; // m of the eye
const matrix = Float32Array.from([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, height, 0, 1]);
const lens = Float32Array.from([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, -1, 0, 0, -0.04, 0]);
const pose = { transform: { matrix }, views: [{ eye: 'none', projectionMatrix: lens, transform: { matrix } }] };
window.XRWebGLBinding = undefined;
window.XRWebGLLayer = class {
    framebuffer = null;
    framebufferWidth = 400;
    framebufferHeight = 400;
    getViewport() { return { x: 0, y: 0, width: 400, height: 400 }; }
};
WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
const xr = Object.assign(new EventTarget(), {
    isSessionSupported: async (mode) => modes.includes(mode),
    requestSession: async (mode, { requiredFeatures }) => {
        if (!modes.includes(mode) || `${requiredFeatures}` !== 'local-floor') throw new Error(`no ${mode}`);
        return new Session();
    },
});
Object.defineProperty(navigator, 'xr', { value: xr });
window.modes = modes;
"""
#: Returns the pixels of the canvas, which can be read in the task that has drawn it.
DRAWN = """() => new Promise((resolve) => {
    const canvas = document.querySelector('#canvas');
    canvas.addEventListener('drawn', () => resolve(canvas.toDataURL().split(',')[1]), { once: true });
})"""


def test_where_a_headset_is_present_the_shape_stands_before_the_viewer(window: Open) -> None:
    studio = window()
    studio.page.add_init_script(f"{{ {HEADSET} }}")
    studio.open()
    flat = studio.picture()
    button = studio["#headset"]
    studio.eventually(button.is_visible)
    assert "in the headset" in (button.get_attribute("title") or "")
    button.click()
    studio.eventually(lambda: button.get_attribute("aria-pressed") == "true")
    seen = pixels(base64.b64decode(studio.page.evaluate(DRAWN)))
    assert seen.shape[:2] == (400, 400)
    rows, columns = np.nonzero(seen[..., 0] - seen[..., 2] > 20)
    # With a field of view of 90 degrees, a shape of 1.8 m at a distance of 2.2 m fills about 40 %.
    assert 0.2 < np.ptp(columns) / 400 < 0.6
    assert abs(columns.mean() - 200) < 20, "it stands before the viewer"
    assert rows.mean() > 200, "its middle is lower than the eye"
    button.click()
    studio.eventually(lambda: button.get_attribute("aria-pressed") == "false")
    studio["#theme"].focus()  # so that the button has no focus ring
    studio.eventually(lambda: difference(flat, studio.picture()) < 0.002)
    # One that shows the room as well is better.
    studio.page.evaluate("modes.push('immersive-ar'), navigator.xr.dispatchEvent(new Event('devicechange'))")
    studio.eventually(lambda: "in your room" in (button.get_attribute("title") or ""))


def test_no_headset_no_button(studio: OpenPage) -> None:
    assert studio["#headset"].is_hidden()


@pytest.mark.long  # the page waits for ten seconds
def test_a_browser_that_records_no_pictures_keeps_no_empty_video(window: Open) -> None:
    studio = window().open()
    studio.page.evaluate(
        "() => { const { captureStream } = HTMLCanvasElement.prototype;"
        "HTMLCanvasElement.prototype.captureStream ="
        " (rate) => captureStream.call(document.createElement('canvas'), rate); }"
    )
    studio.tab("Files")
    studio["#turntable-seconds"].fill("1")
    studio["#turntable"].click()
    studio.eventually(lambda: "This browser records no pictures of the shape." in studio.messages)
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
