"""One server for all tests of the page, a browser for each file of tests, and a new window for each test."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, sync_playwright

from shapespace.files.reading import read_arrays
from tests.page.studio import OpenPage
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, start, starting  # noqa: F401 - a fixture

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
#: WebGL in software, which works on every machine.
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

#: A code of the small torus.
CODE = (0.1, 1, 0.5)

Open = Callable[..., OpenPage]


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
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def window(browser: Browser, server: Server) -> Iterator[Open]:
    """Opens windows; checks at the end that none had errors or sent requests to another host."""
    windows: list[tuple[OpenPage, bool]] = []

    def open(url: str = server.url, *, complains: bool = False, **options: Any) -> OpenPage:
        context = browser.new_context(
            **{"viewport": {"width": 1000, "height": 640}, "reduced_motion": "reduce", **options}
        )
        studio = OpenPage(context.new_page(), url)
        windows.append((studio, complains))
        return studio

    yield open
    for studio, complains in windows:
        studio.page.context.close()
        assert studio.foreign == []
        assert complains or studio.complaints == []


@pytest.fixture
def studio(window: Open) -> OpenPage:
    """The page with the small torus, after its shape has been drawn."""
    return window().open()


@pytest.fixture
def expected(server: Server) -> np.ndarray:
    """Positions of the code, as the server answers them."""
    call = f"{server.url}/v1/models/with-fine/mesh?latent={','.join(map(str, CODE))}&format=npz"
    return read_arrays(httpx.get(call, timeout=60).raise_for_status().content, "npz")[0]
