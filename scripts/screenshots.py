"""Write the screenshots of the page in docs/, of bundled models: ``python -m scripts.screenshots``."""

from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from benchmarks.processes import server
from tests.page.conftest import CHROMIUM, FLAGS

DOCS = Path("docs")
POSE = "0.3,-0.2,0.5,0.1,-0.6,0.3,0.2,0.4,0,0.7,-0.3,0.2,0.5,0.6,-0.4,0.2,0.3,-0.2,0.6,0.3"
OTHER = "-0.5,0.4,-0.3,0.2,0.6,-0.4,0.1,-0.5,0.3,-0.6,0.4,0.1,-0.4,-0.5,0.5,-0.3,0.2,0.4,-0.5,0.6"
FIGURE = f"#model=figure&z={POSE}"
TORUS = "#model=freaky-torus&z=1,2,0.4,1"


def drawn(page: Page, pictures: str) -> None:
    """Wait until the shape is drawn and the small pictures are there."""
    page.wait_for_selector(".stage[data-shown]")
    page.wait_for_selector(f"{pictures} canvas.drawn")
    while page.locator(f"{pictures} canvas:not(.drawn)").count():
        page.wait_for_timeout(100)
    page.wait_for_timeout(1500)


def main() -> None:
    """Take the screenshots."""
    desktop, phone = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
    with server(Path("models")) as (client, *_), sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)

        def open_page(hash: str, **options: object) -> Page:
            page = browser.new_page(**options)  # type: ignore[arg-type]
            page.set_default_timeout(120_000)
            page.goto(f"{client.base_url}{hash}")
            return page

        page = open_page(FIGURE, viewport=desktop)
        drawn(page, ".pictures")
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

        page = open_page(TORUS, viewport=phone, device_scale_factor=2, is_mobile=True, has_touch=True)
        drawn(page, ".pictures")
        page.screenshot(path=DOCS / "page-phone.png")
        browser.close()


if __name__ == "__main__":
    main()
