"""Write the screenshots in docs/: of the page, and of what the first tutorial makes.

``python -m scripts.screenshots`` shows bundled models. ``python -m scripts.screenshots FOLDER`` writes the pictures of
docs/tutorial/first-model.md alone; somebody has followed this tutorial in FOLDER.
"""

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from benchmarks.processes import server
from tests.page.conftest import CHROMIUM, FLAGS

DOCS = Path("docs")
POSE = "0.3,-0.2,0.5,0.1,-0.6,0.3,0.2,0.4,0,0.7,-0.3,0.2,0.5,0.6,-0.4,0.2,0.3,-0.2,0.6,0.3"
OTHER = "-0.5,0.4,-0.3,0.2,0.6,-0.4,0.1,-0.5,0.3,-0.6,0.4,0.1,-0.4,-0.5,0.5,-0.3,0.2,0.4,-0.5,0.6"
FIGURE = f"#model=figure&z={POSE}"
#: Code of the model of the first tutorial: `POSE` of the figure, encoded.
BENT = (
    "-0.29,0.04,-0.12,0.22,-0.25,0.14,1.11,-0.05,0.07,0.15,-1.14,3.07,8.94,-4.05,5.69,"
    "-1.52,-0.57,-0.71,-0.41,0.89,-0.29,-0.54,5.88,3.32,2.04,-0.91,2.63,-8.92,0.9,-0.18"
)
TORUS = "#model=freaky-torus&z=1,2,0.4,1"


def drawn(page: Page, pictures: str) -> None:
    """Wait until the shape is drawn and the small pictures are there."""
    page.wait_for_selector(".stage[data-shown]")
    page.wait_for_selector(f"{pictures} canvas.drawn")
    while page.locator(f"{pictures} canvas:not(.drawn)").count():
        page.wait_for_timeout(100)
    page.wait_for_timeout(1500)


def save_small(page: Page, path: Path) -> None:
    """Save a screenshot as WebP, which takes a tenth of the space of PNG."""
    Image.open(io.BytesIO(page.screenshot())).save(path, quality=82, method=6)


def first_model(folder: Path) -> None:
    """Take the screenshots of the first tutorial: the head of its report, and the page with its model."""
    with server(folder / "models") as (client, *_), sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1100, "height": 690})
        page.goto((folder / "runs" / "meshes" / "report.html").resolve().as_uri())
        save_small(page, DOCS / "tutorial" / "report.webp")
        page.goto(f"{client.base_url}#model=meshes&z={BENT}")
        page.set_default_timeout(120_000)
        drawn(page, ".end")
        save_small(page, DOCS / "tutorial" / "page.webp")
        browser.close()


def main() -> None:
    """Take the screenshots of bundled models."""
    desktop, phone = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
    tutorial = {"width": 1100, "height": 690}
    with server(Path("models")) as (client, *_), sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)

        def open_page(hash: str, **options: object) -> Page:
            page = browser.new_page(**options)  # type: ignore[arg-type]
            page.set_default_timeout(120_000)
            page.goto(f"{client.base_url}{hash}")
            return page

        page = open_page(FIGURE, viewport=desktop)
        drawn(page, ".end")
        page.screenshot(path=DOCS / "page-desktop.png")

        page = open_page(f"{FIGURE}&keys={POSE};{OTHER}&colour=stretch", viewport=desktop, color_scheme="dark")
        page.get_by_role("tab", name="Path").click()
        drawn(page, "#keyframes")
        page.locator("#draw-strip").click()
        drawn(page, "#strip")
        page.screenshot(path=DOCS / "page-dark.png")

        page = open_page(f"{FIGURE}&other={OTHER}&against=-2&colour=distance", viewport=desktop)
        page.get_by_role("tab", name="Colour").click()
        page.wait_for_selector("#legend .numbers:not(:empty)")
        page.wait_for_timeout(3000)
        page.screenshot(path=DOCS / "page-beside.png")

        page = open_page(FIGURE, viewport=tutorial)
        drawn(page, ".end")
        answer = client.get("/v1/models/figure/mesh", params={"latent": ",".join(["0.2"] * 20), "format": "obj"})
        points = [line.split()[1:] for line in answer.text.splitlines() if line.startswith("v ")]
        cloud = "\n".join(f"{x} {float(y) + 5} {z}" for x, y, z in points).encode()
        page.get_by_role("tab", name="Files").click()
        page.locator("#mesh-file").set_input_files({"name": "cloud.xyz", "mimeType": "text/plain", "buffer": cloud})
        page.wait_for_selector("#verdict:is(.good, .fair, .poor)")
        page.wait_for_timeout(3000)
        save_small(page, DOCS / "tutorial" / "scan.webp")

        page = open_page(TORUS, viewport=phone, device_scale_factor=2, is_mobile=True, has_touch=True)
        drawn(page, ".end")
        page.screenshot(path=DOCS / "page-phone.png")
        browser.close()


if __name__ == "__main__":
    if sys.argv[1:]:
        first_model(Path(sys.argv[1]))
    else:
        main()
