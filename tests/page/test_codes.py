"""Codes from the server: of a file, of a pull at a vertex, and random ones."""

from __future__ import annotations

from pathlib import Path

import httpx
import numpy as np

from shapespace.files.formats import MESH_FORMATS
from shapespace.files.reading import read_arrays
from tests.page.conftest import CODE, Open
from tests.page.studio import OpenPage
from tests.service.conftest import Server


def test_a_file_is_encoded(studio: OpenPage, expected: np.ndarray, server: Server, tmp_path: Path) -> None:
    faces = read_arrays(httpx.get(f"{server.url}/v1/models/with-fine/mesh?format=npz").content, "npz")[1]
    turned = expected @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) + [1, 2, 3]
    path = tmp_path / "pose.obj"
    path.write_bytes(MESH_FORMATS["obj"].encode(turned, faces))
    studio.tab("Files")
    studio["#mesh-file"].set_input_files(path)
    studio.until_code(CODE, 0.02)
    words = studio.eventually(lambda: t if "the code of pose.obj" in (t := studio["#verdict"].inner_text()) else None)
    assert "vertices are off by" in words
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


def test_a_file_that_is_none_is_refused_in_the_page(window: Open) -> None:
    studio = window(complains=True).open()  # the browser logs every refused request in its console
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
    studio["#random"].click()
    studio.eventually(lambda: studio.code != first)
    studio.coordinate(2).locator("[data-do=lock]").click()
    locked = studio.code[2]
    studio["#seed"].fill("1")
    studio["#seed"].press("Enter")
    studio.until_code([*first[:2], locked])


def test_a_pull_keeps_what_is_locked(studio: OpenPage) -> None:
    studio.coordinate(1).locator("[data-do=lock]").click()
    sent = []
    studio.page.on("request", lambda request: sent.append(request.post_data_json) if "/edit" in request.url else None)
    studio["#pull"].click()
    before = studio.picture()
    box = studio["#canvas"].bounding_box()
    assert box
    inside = np.abs(before - before[0, 0]).max(axis=2) > 40
    x = int(np.flatnonzero(inside.any(axis=0))[-1]) - 6
    y = int(np.median(np.flatnonzero(inside[:, x])))
    studio.page.mouse.move(box["x"] + x, box["y"] + 60 + y)
    studio.page.mouse.down()
    studio.page.mouse.move(box["x"] + x + 15, box["y"] + 60 + y, steps=3)
    studio.page.wait_for_timeout(200)
    studio.page.mouse.up()
    studio.eventually(lambda: any(studio.code))
    assert studio.code[1] == 0
    assert sent[0]["fixed"] == {"1": 0}


def test_pulling_at_a_vertex_takes_the_shape_along(studio: OpenPage) -> None:
    studio["#pull"].click()
    before = studio.picture()
    box = studio["#canvas"].bounding_box()
    assert box
    # The rightmost point of the torus, in the picture.
    inside = np.abs(before - before[0, 0]).max(axis=2) > 40
    x = int(np.flatnonzero(inside.any(axis=0))[-1]) - 6
    y = int(np.median(np.flatnonzero(inside[:, x])))
    place = box["x"] + x, box["y"] + 60 + y
    studio.page.mouse.move(*place)
    studio.page.mouse.down()
    studio.page.mouse.move(place[0] + 12, place[1], steps=3)
    studio.page.mouse.move(place[0] + 18, place[1], steps=3)
    studio.page.wait_for_timeout(200)
    studio.page.mouse.up()
    studio.eventually(lambda: any(abs(value) > 0.02 for value in studio.code))
    studio["#theme"].hover()
    studio.rest()
    after = studio.until_different(before)
    reach = int(np.flatnonzero((np.abs(after - after[0, 0]).max(axis=2) > 40).any(axis=0))[-1])
    assert reach > x + 8, "the shape did not follow the pointer"
    studio["#undo"].click()
    studio.until_code([0, 0, 0])
