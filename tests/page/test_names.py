"""Names that users give to factors and coordinates."""

from tests.page.conftest import Open, Visit
from tests.page.studio import OpenPage
from tests.page.test_operation import AXE, check


def headings(studio: OpenPage) -> list[str]:
    return studio[".factor h2"].all_inner_texts()


def test_people_name_things_for_themselves(visit: Visit) -> None:
    studio = visit()
    own = headings(studio)
    slider = studio.coordinate(1).locator("input[type=range]")
    before = slider.get_attribute("aria-label")
    studio["#name"].click()
    studio.page.evaluate(AXE.read_text())
    check(studio, "names")
    studio.page.get_by_label("Name for the factor form").fill("  Figure and twist ")
    studio.page.get_by_label("Name for turn").fill("<b>Turn</b>")
    studio.page.get_by_role("button", name="Keep", exact=True).click()
    assert headings(studio) == [own[0], "Figure and twist"]
    assert studio.coordinate(1).locator(".name").inner_text() == "<b>Turn</b>"
    assert slider.get_attribute("aria-label") == "Figure and twist, <b>Turn</b>"
    assert studio.page.get_by_role("button", name="Reset all of Figure and twist", include_hidden=True).count() == 1

    studio.page.reload()
    studio.rest()
    assert headings(studio) == [own[0], "Figure and twist"]
    assert studio["#model"].select_option("Figure")
    studio.eventually(lambda: "Figure and twist" not in headings(studio))
    studio["#model"].select_option("with-fine")
    studio.eventually(lambda: headings(studio) == [own[0], "Figure and twist"])
    studio.tab("Path")
    studio["#add-keyframe"].click()
    studio["#add-keyframe"].click()
    studio["#draw-strip"].click()
    studio.eventually(lambda: "Figure and twist" in studio["#strip"].inner_text())

    studio.tab("Shape")
    studio["#name"].click()
    studio.page.get_by_role("button", name="The model's own names").click()
    assert headings(studio) == own
    assert slider.get_attribute("aria-label") == before
    assert "Figure and twist" not in studio.page.evaluate("JSON.stringify({ ...localStorage })")


def test_the_fields_for_names_say_what_the_sliders_say(visit: Visit) -> None:
    studio = visit("#model=figure")
    names = studio[".coordinate .name"]
    studio.eventually(lambda: "↔" in (names.nth(19).text_content() or ""), 300)
    told = names.all_text_contents()
    studio["#name"].click()
    fields = studio["#names input[data-key^=coordinate]"]
    assert fields.first.get_attribute("placeholder") == told[0]
    assert fields.first.get_attribute("aria-label") == f"Name for left hip, {told[0].replace('↔', 'to')}"
    assert not any(text.strip().isdigit() for text in studio["#names label"].all_inner_texts())
    studio.page.keyboard.press("Escape")


def test_broken_memory_of_names_does_no_harm(window: Open) -> None:
    studio = window()
    studio.page.add_init_script("localStorage.setItem('names:with-fine', '[{\"a\"')")
    studio.open()
    assert len(headings(studio)) == 2
