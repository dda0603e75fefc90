"""One server for all tests of the page; a browser and a loaded page for each file of tests."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, sync_playwright

from shapespace.files.reading import read_arrays
from tests.page.studio import PATIENCE, OpenPage
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, start, starting  # noqa: F401 - a fixture

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
#: WebGL in software, which works on every machine.
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
#: All but the shape is drawn without WebGL, which takes a third of the processor's time.
TEST_FLAGS = [*FLAGS, "--disable-gpu-compositing"]

#: Width and height of a window.
SIZE = (1000, 640)
#: A code of the small torus.
CODE = (0.1, 1, 0.5)

Open = Callable[..., OpenPage]
Visit = Callable[..., OpenPage]


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled figure, and a small torus with an angle among its coordinates and a fine mesh."""
    folder = tmp_path_factory.mktemp("page") / "models"
    shutil.copytree(ROOT / "models" / "figure", folder / "figure")
    write_bundle(folder, "with-fine", fine=True)
    return folder


@pytest.fixture(scope="session")
def server(models: Path) -> Iterator[Server]:
    with starting() as begin:
        yield begin(models, workers=2, deadline=300)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """The system's Chromium, or else the one that `playwright install chromium` downloads.

    It is closed after each file of tests, since no other event loop can run in this thread while it is open.
    """
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=TEST_FLAGS, timeout=1000 * PATIENCE)
        yield browser
        browser.close()


def _opened(browser: Browser, url: str, options: dict[str, Any]) -> OpenPage:
    usual = {"viewport": dict(zip(("width", "height"), SIZE, strict=True)), "reduced_motion": "reduce"}
    return OpenPage(browser.new_context(**{**usual, **options}).new_page(), url)


@pytest.fixture
def window(browser: Browser, server: Server) -> Iterator[Open]:
    """Opens new windows; checks at the end that none had errors or sent requests to another host."""
    windows: list[tuple[OpenPage, bool]] = []

    def open(url: str = server.url, *, complains: bool = False, **options: Any) -> OpenPage:
        windows.append((_opened(browser, url, options), complains))
        return windows[-1][0]

    yield open
    for studio, complains in windows:
        studio.let_through()
        studio.page.context.close()
        studio.require_calm(complains)


@pytest.fixture(scope="module")
def shared(browser: Browser, server: Server) -> list[OpenPage]:
    """The window that the tests of a file use one after the other."""
    return [_opened(browser, server.url, {})]


@pytest.fixture
def visit(request: pytest.FixtureRequest, browser: Browser, server: Server, shared: list[OpenPage]) -> Iterator[Visit]:
    """Shows an address on the page that earlier tests of the file have loaded, as if it were new.

    Loading takes seconds, most of them in software for WebGL. Tests that need a new page use `window`.
    """
    failed, complaining = request.session.testsfailed, False

    def visit(hash: str = "#model=with-fine", *, size: tuple[int, int] = SIZE, complains: bool = False) -> OpenPage:
        nonlocal complaining
        complaining = complains
        return shared[0].visit(hash, size)

    yield visit
    studio = shared[0]
    if request.session.testsfailed > failed:  # who knows what it has left behind
        studio.page.context.close()
        shared[0] = _opened(browser, server.url, {})
    else:
        studio.require_calm(complaining)


@pytest.fixture
def studio(visit: Visit) -> OpenPage:
    """The page with the small torus, after its shape has been drawn."""
    return visit()


@pytest.fixture
def expected(server: Server) -> np.ndarray:
    """Positions of the code, as the server answers them."""
    call = f"{server.url}/v1/models/with-fine/mesh?latent={','.join(map(str, CODE))}&format=npz"
    return read_arrays(httpx.get(call, timeout=60).raise_for_status().content, "npz")[0]
