"""Meshes and codes in and out of the page."""

from __future__ import annotations

import io
import json
import shlex
import zipfile
from pathlib import Path

import httpx
import numpy as np
import pytest

from geometry.formats import MESH_FORMATS, read_arrays
from tests.page.conftest import Open
from tests.page.studio import Studio, difference
from tests.service.conftest import Server

CODE = (0.1, 1, 0.5)


def move(studio: Studio, code: tuple[float, ...] = CODE) -> None:
    for k, value in enumerate(code):
        studio.type(k, value)
    studio.until_code(code)
    studio.rest()


@pytest.fixture
def expected(server: Server) -> np.ndarray:
    """Positions of the code, as the server answers them."""
    call = f"{server.url}/v1/models/with-fine/mesh?latent={','.join(map(str, CODE))}&format=npz"
    return read_arrays(httpx.get(call, timeout=60).raise_for_status().content, "npz")[0]


def test_a_download_in_every_format(studio: Studio, expected: np.ndarray, tmp_path: Path) -> None:
    move(studio)
    studio.tab("Files")
    formats = studio["#format option"].all_inner_texts()
    assert formats == [*MESH_FORMATS, "json"]
    for format in formats:
        studio["#format"].select_option(format)
        with studio.page.expect_download() as download:
            studio["#download"].click()
        assert download.value.suggested_filename == f"with-fine.{format}"
        path = tmp_path / download.value.suggested_filename
        download.value.save_as(path)
        if format == "json":
            vertices = np.array(json.loads(path.read_text())["vertices"])
        else:
            vertices, faces = read_arrays(path)
            if format == "stl":  # corner by corner
                vertices, around = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)
                assert len(np.unique(around[faces], axis=0)) == len(faces)
                assert np.allclose(vertices, np.unique(expected.astype(np.float32), axis=0), atol=1e-5)
                continue
        assert np.allclose(vertices, expected, atol=1e-5), format


def test_a_download_of_the_path(studio: Studio, expected: np.ndarray) -> None:
    studio.tab("Path")
    studio["#add-keyframe"].click()
    studio.tab("Shape")
    move(studio)
    studio.tab("Path")
    studio["#add-keyframe"].click()
    for format in studio["#animation-format option"].evaluate_all("all => all.map(({ value }) => value)"):
        studio["#animation-format"].select_option(format)
        with studio.page.expect_download() as download:
            studio["#download-animation"].click()
        content = Path(download.value.path()).read_bytes()
        assert download.value.suggested_filename == f"with-fine-animation.{format}"
        if format == "zip":
            archive = zipfile.ZipFile(io.BytesIO(content))
            names = sorted(archive.namelist())
            assert len(names) == 25
            assert np.allclose(read_arrays(archive.read(names[-1]), "obj")[0], expected, atol=1e-5)
        elif format == "npz":
            assert np.allclose(np.load(io.BytesIO(content))["vertices"][-1], expected, atol=1e-5)
        elif format == "jsonl":
            assert np.allclose(json.loads(content.splitlines()[-1])["vertices"], expected, atol=1e-5)
        else:
            assert content.startswith({"glb": b"glTF", "pc2": b"POINTCACHE2"}[format])


def test_the_copied_call_answers_the_shape(studio: Studio, expected: np.ndarray) -> None:
    studio.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    move(studio)
    studio.tab("Files")
    studio["#format"].select_option("obj")
    studio["#copy-curl"].click()
    studio.eventually(lambda: "Copied the call" in studio.messages)
    command = shlex.split(studio.page.evaluate("navigator.clipboard.readText()"))
    assert command[0] == "curl"
    options = dict(zip(command[2::2], command[3::2], strict=True))
    name, _, value = options["-H"].partition(": ")
    answer = httpx.post(command[1], content=options["-d"], headers={name: value}, timeout=60).raise_for_status()
    assert options["-o"] == "with-fine.obj"
    assert np.allclose(read_arrays(answer.content, "obj")[0], expected, atol=1e-5)


def test_the_address_restores_everything(studio: Studio, window: Open) -> None:
    studio.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    move(studio)
    studio.tab("Path")
    studio["#add-keyframe"].click()
    studio.tab("Shape")
    studio.type(2, 0.2)
    studio.tab("Path")
    studio["#add-keyframe"].click()
    studio["#beyond"].select_option("0.25")
    studio.tab("Shape")
    studio.coordinate(1).locator("[data-do=lock]").click()
    studio["#wireframe"].click()
    studio.tab("Colour")
    studio.page.get_by_label("bending").check()
    studio["#against"].select_option("keyframe 1")
    studio["#canvas"].focus()
    studio.page.keyboard.press("ArrowRight")
    studio["#share"].click()
    studio.eventually(lambda: "Copied the address" in studio.messages)
    address = studio.page.evaluate("navigator.clipboard.readText()")
    studio.rest()

    other = window().open(address.removeprefix(studio.url + "/"))
    other.until_code([0.1, 1, 0.2])
    assert other.hash == studio.hash
    assert other["#wireframe"].get_attribute("aria-pressed") == "true"
    assert other.coordinate(1).locator("input[type=range]").is_disabled()
    assert other["#keyframes > li"].count() == 2
    assert other["#beyond"].input_value() == "0.25"
    assert other["#against"].input_value() == "0"
    studio["#messages button"].click()
    studio["#theme"].focus()
    other.eventually(lambda: difference(studio.picture(), other.picture()) < 0.01)

    # Back in the first window, by hand in the address bar.
    studio.page.evaluate("location.hash = '#model=with-fine&z=0.05,0,0'")
    studio.until_code([0.05, 0, 0])
    assert studio["#keyframes > li"].count() == 0
    assert studio["#wireframe"].get_attribute("aria-pressed") == "false"


def test_a_file_is_encoded(studio: Studio, expected: np.ndarray, server: Server, tmp_path: Path) -> None:
    faces = read_arrays(httpx.get(f"{server.url}/v1/models/with-fine/mesh?format=npz").content, "npz")[1]
    turned = expected @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) + [1, 2, 3]
    path = tmp_path / "pose.obj"
    path.write_bytes(MESH_FORMATS["obj"].encode(turned, faces))
    studio.tab("Files")
    studio["#mesh-file"].set_input_files(path)
    studio.until_code(CODE, 0.02)
    studio.eventually(lambda: "the code of pose.obj" in studio.messages)
    assert "fit to" in studio.messages

    # The same by dropping it, after the shape has moved on.
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
    studio = window(complains=True).open()  # the browser's console names every refusal
    studio.tab("Files")
    studio["#mesh-file"].set_input_files({"name": "x.obj", "mimeType": "model/obj", "buffer": b"v 0 0 0\n"})
    message = studio.eventually(lambda: studio["#messages .error"].first.inner_text() or None)
    assert message.startswith("x.obj: ")
    assert len(message) > 20
    assert studio.code in ([], [0, 0, 0])


def test_random_shapes_repeat_by_their_seed(studio: Studio) -> None:
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


def test_pulling_at_a_vertex_takes_the_shape_along(studio: Studio) -> None:
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
    assert reach > x + 8, "the shape did not follow the hand"
    studio["#undo"].click()
    studio.until_code([0, 0, 0])
