"""Codes from the server: of a file, and random ones."""

from pathlib import Path

import httpx
import numpy as np

from shapespace.files.formats import MESH_FORMATS
from shapespace.files.reading import read_arrays
from tests.page.conftest import CODE, Visit
from tests.page.studio import Hold, OpenPage
from tests.service.conftest import Server


def test_a_file_is_encoded(studio: OpenPage, expected: np.ndarray, server: Server, tmp_path: Path) -> None:
    faces = read_arrays(httpx.get(f"{server.url}/v1/models/with-fine/mesh?format=npz").content, "npz")[1]
    turned = expected @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) + [1, 2, 3]
    path = tmp_path / "pose.obj"
    path.write_bytes(MESH_FORMATS["obj"].encode(turned, faces))
    studio.tab("Files")
    studio["#mesh-file"].set_input_files(path)
    studio.until_code(CODE, 0.02)
    words = studio.eventually(lambda: t if "The shape of pose.obj" in (t := studio["#verdict"].inner_text()) else None)
    assert "Mean vertex error" in words
    studio.page.get_by_role("button", name="Back to my shape").click()
    studio.until_code([0, 0, 0])
    studio.page.get_by_role("button", name="Show what was found").click()
    studio.until_code(CODE, 0.02)

    # The same by drag and drop, after another change of the shape.
    studio.tab("Shape")
    studio["#reset-all"].click()
    studio.until_code([0, 0, 0])
    drop = """([name, text]) => {
        const dataTransfer = new DataTransfer();
        dataTransfer.items.add(new File([text], name));
        document.querySelector('#canvas').dispatchEvent(new DragEvent('dragover', { bubbles: true, dataTransfer }));
        const hint = getComputedStyle(document.querySelector('.drop')).display;
        document.querySelector('#canvas').dispatchEvent(new DragEvent('drop', { bubbles: true, dataTransfer }));
        return hint;
    }"""
    assert studio.page.evaluate(drop, ["pose.obj", path.read_text()]) == "grid"
    studio.until_code(CODE, 0.02)


def test_a_file_that_is_none_is_refused_in_the_page(visit: Visit) -> None:
    studio = visit(complains=True)  # the browser logs every refused request in its console
    studio.tab("Files")
    studio["#mesh-file"].set_input_files({"name": "x.obj", "mimeType": "model/obj", "buffer": b"v 0 0 0\n"})
    message = studio.eventually(lambda: studio["#messages .error"].first.inner_text() or None)
    assert message.startswith("x.obj: ")
    assert len(message) > 20
    assert studio.code in ([], [0, 0, 0])


def test_random_shapes_repeat_by_their_seed(studio: OpenPage) -> None:
    start = studio.picture()
    studio["#random"].click()
    studio.until_different(start)
    assert studio["#seed"].input_value() == "1"
    first = studio.eventually(lambda: studio.code if any(studio.code) else None)
    for typed, taken in (("-4", "0"), ("1e300", "999999"), ("2.6", "3")):
        studio["#seed"].fill(typed)
        studio["#seed"].press("Enter")
        assert studio["#seed"].input_value() == taken
    studio["#seed"].fill("999999")
    studio["#random"].click()
    assert studio["#seed"].input_value() == "0", "after the last seed comes the first"
    studio["#random"].click()
    studio.until_code(first)
    assert studio.messages == ""
    held = Hold(studio.page, "**/sample*")
    for count in (1, 2):
        studio["#random"].click()
        studio.eventually(lambda count=count: len(held.routes) == count)  # type: ignore[misc]
    held.routes.pop().continue_()
    second = studio.eventually(lambda: studio.code if studio.code != first else None)
    held.routes.pop().abort()
    studio.frames(3)
    assert (studio.code, studio.messages) == (second, ""), "an earlier answer is no longer wanted"
    studio.let_through()
    studio["#random"].click()
    studio.eventually(lambda: studio.code != second)
    studio.coordinate(2).locator("[data-do=lock]").click()
    locked = studio.code[2]
    studio["#seed"].fill("1")
    studio["#seed"].press("Enter")
    studio.until_code([*first[:2], locked])
    for k in range(2):
        studio.coordinate(k).locator("[data-do=lock]").click()
    studio["#random"].click()
    studio.eventually(lambda: "All sliders are locked" in studio.messages)


def test_a_random_shape_is_not_for_the_model_after(studio: OpenPage) -> None:
    held = Hold(studio.page, "**/sample*")
    studio["#random"].click()
    studio.eventually(lambda: bool(held.routes))
    studio["#model"].select_option("Figure")
    studio.until_code([0] * 20)
    with studio.page.expect_response("**/sample*"):
        held.release()
    studio.frames(3)
    studio.rest()
    assert (studio.code, studio.messages) == ([0] * 20, "")
