"""Saving and opening meshes and codes on the page."""

import io
import json
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path
from zipfile import ZipFile

import httpx
import numpy as np

from shapespace.files.formats import MESH_FORMATS
from shapespace.files.reading import read_arrays
from tests.page.conftest import CODE, Open
from tests.page.studio import OpenPage, difference
from tests.service.glb import GLB


def move(studio: OpenPage, code: tuple[float, ...] = CODE) -> None:
    for k, value in enumerate(code):
        studio.type(k, value)
    studio.until_code(code)
    studio.rest()


def test_a_download_in_every_format(studio: OpenPage, expected: np.ndarray, tmp_path: Path) -> None:
    move(studio)
    studio.tab("Files")
    formats = studio["#format option"].all_inner_texts()
    assert formats == [*MESH_FORMATS, "zip", "json"]
    for format in formats:
        studio["#format"].select_option(format)
        with studio.page.expect_download() as download:
            studio["#download"].click()
        assert download.value.suggested_filename == f"with-fine.{format}"
        path = tmp_path / download.value.suggested_filename
        download.value.save_as(path)
        if format == "zip":
            path = Path(ZipFile(path).extract("shape.obj", tmp_path))
        if format == "json":
            vertices = np.array(json.loads(path.read_text())["vertices"])
        else:
            vertices, faces = read_arrays(path)
            if format == "stl":  # STL has the corners of each triangle
                vertices, around = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)
                assert len(np.unique(around[faces], axis=0)) == len(faces)
                assert np.allclose(vertices, np.unique(expected.astype(np.float32), axis=0), atol=1e-5)
                continue
        assert np.allclose(vertices, expected, atol=1e-5), format


def test_a_download_of_the_path(studio: OpenPage, expected: np.ndarray) -> None:
    studio.tab("Path")
    studio["#add-keyframe"].click()
    studio.tab("Shape")
    move(studio)
    studio.tab("Path")
    studio["#add-keyframe"].click()
    formats = studio.eventually(lambda: studio["#animation-format option"].all_inner_texts() or None)
    assert {"glb", "zip", "npz", "pc2", "jsonl"} <= set(formats)
    for format in formats:
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
            begins = {"glb": b"glTF", "pc2": b"POINTCACHE2", "usd": b"PXR", "usdz": b"PK"}
            assert content.startswith(begins[format])
    studio["#path-name"].fill("Grow and twist")
    studio["#animation-format"].select_option("glb")
    with studio.page.expect_download() as download:
        studio["#download-animation"].click()
    assert download.value.suggested_filename == "Grow and twist.glb"
    glb = GLB(Path(download.value.path()).read_bytes())
    assert [animation["name"] for animation in glb.tree["animations"]] == ["Grow and twist"]


def test_the_copied_calls_answer_the_shape(studio: OpenPage, expected: np.ndarray, tmp_path: Path) -> None:
    studio.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    move(studio)
    studio.tab("Files")
    studio["#format"].select_option("obj")

    def copied(language: str) -> str:
        studio["#language"].select_option(language)
        studio["#copy-code"].click()
        text = studio["#code"].text_content()
        studio.eventually(lambda: studio.page.evaluate("navigator.clipboard.readText()") == text)
        return text or ""

    command = shlex.split(copied("curl"))
    assert command[0] == "curl"
    options = dict(zip(command[2::2], command[3::2], strict=True))
    name, _, value = options["-H"].partition(": ")
    answer = httpx.post(command[1], content=options["-d"], headers={name: value}, timeout=60).raise_for_status()
    assert options["-o"] == "with-fine.obj"
    subprocess.run([sys.executable, "-c", copied("Python")], cwd=tmp_path, check=True)
    script = f"async () => {{ {copied('JavaScript')}; return new TextDecoder().decode(file); }}"
    files = [answer.content, (tmp_path / "with-fine.obj").read_bytes(), studio.page.evaluate(script).encode()]
    for content in files:
        assert np.allclose(read_arrays(content, "obj")[0], expected, atol=1e-5)


def test_the_address_restores_everything(studio: OpenPage, window: Open) -> None:
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
    assert "&against=0.1,1,0.5" in (studio["#code"].text_content() or ""), "numbers that people can read"
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
    studio.eventually(lambda: studio["#messages .message:visible"].count() == 0)
    studio["#theme"].hover()
    studio["#theme"].focus()
    other.eventually(lambda: difference(studio.picture(), other.picture()) < 0.03)

    # In the first window again, as if typed into the address bar.
    studio.page.evaluate("location.hash = '#model=with-fine&z=0.05,0,0'")
    studio.eventually(lambda: studio.coordinate(0).locator("input[type=number]").input_value() == "0.05")
    assert studio["#keyframes > li"].count() == 0
    assert studio["#wireframe"].get_attribute("aria-pressed") == "false"
