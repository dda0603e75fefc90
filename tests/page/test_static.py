"""The page as static files, below a folder of a plain web server."""

import gzip
import hashlib
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import httpx
import numpy as np
import pytest

from shapespace.commands.page import page
from shapespace.files.formats import MESH_FORMATS
from shapespace.files.reading import read_arrays
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel, load
from shapespace.page_scripts import PAGE
from tests.page.conftest import Open
from tests.page.studio import Hold, OpenPage
from tests.page.test_texture import dressed
from tests.service.conftest import ROOT, Server
from tests.surfaces import png

MEGABYTES = 16


@dataclass(frozen=True)
class Site:
    """A folder that a web server shows.

    Attributes:
        folder, url: the page's files and their address.
        model: the model of the page.
    """

    folder: Path
    url: str
    model: ShapeModel


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    root = tmp_path_factory.mktemp("site")
    folder = root / "models" / "figure"
    assert page(model=str(ROOT / "models" / "figure"), out=folder, force=False) == 0
    command = [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", str(root)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout
        address = re.search(r"\((http://[^)]+?)/?\)", process.stdout.readline())
        assert address
        yield Site(folder, f"{address[1]}/models/figure", load(ROOT / "models" / "figure"))
        process.terminate()


def saved(studio: OpenPage, button: str) -> bytes:
    """The file that a button saves."""
    with studio.page.expect_download() as download:
        studio[button].click()
    return Path(download.value.path()).read_bytes()


def test_sliders_random_shapes_paths_and_downloads_need_no_server(site: Site, window: Open) -> None:
    size = sum(path.stat().st_size for path in site.folder.rglob("*") if path.is_file())
    assert size < 1e6 * MEGABYTES
    studio = window(site.url)
    # The first shape needs neither the decoder nor random codes.
    held = Hold(studio.page, re.compile(r"decoder\.onnx|\.wasm|codes\.npz"))
    studio.open("index.html")
    held.release()
    still = studio.picture()
    studio.slide(0, 0.8)
    studio.until_code([0.8] + 19 * [0])
    studio.until_different(still)
    assert studio["#diagnostics summary"].inner_text() == "Looks right"

    studio["#random"].click()
    code = np.clip(site.model.sample(1, 1, "population")[0], site.model.lower, site.model.upper)
    studio.until_code(code)
    studio.eventually(lambda: not studio.waits)
    studio.tab("Files")
    vertices, faces = read_arrays(saved(studio, "#download"), "glb")[:2]
    expected = site.model.shape(np.round(code.astype(float), 6), quality="draft").vertices
    assert np.array_equal(faces, site.model.faces)
    assert np.abs(vertices - expected).max() < 2e-5 * np.linalg.norm(np.ptp(expected, axis=0))
    assert saved(studio, "#picture").startswith(b"\x89PNG")

    studio.tab("Path")
    studio["#add-keyframe"].click()
    studio["#reset-all"].click()
    studio.until_code(20 * [0])
    studio["#add-keyframe"].click()
    timeline = studio["#timeline"]
    timeline.evaluate("line => { line.value = 0.5; line.dispatchEvent(new Event('input', {bubbles: true})); }")
    timeline.evaluate("line => line.dispatchEvent(new Event('change', {bubbles: true}))")
    studio.until_code(code / 2, 1e-2)
    studio.tab("Colour")
    studio.page.get_by_label("stretch").check()
    studio.eventually(studio["#legend"].is_visible)
    assert studio.messages == ""
    assert not [address for address in studio.addresses if re.search(r"/v[12]/|openapi", address)]


def test_what_needs_a_server_says_so(site: Site, window: Open) -> None:
    studio = window(site.url).open("index.html")
    studio["#pull"].click()
    studio.eventually(lambda: "Pulling the shape needs a server" in studio.messages)
    assert studio["#pull"].get_attribute("aria-pressed") == "false"
    studio["#mesh-file"].set_input_files({"name": "scan.ply", "mimeType": "", "buffer": b"ply"})
    studio.eventually(lambda: "scan.ply: Finding the shape of a file needs a server" in studio.messages)
    studio["#about"].click()
    studio.eventually(studio["#card"].is_visible)
    links = studio["a[href]:visible"].evaluate_all("all => all.map(({ href }) => href)")
    assert f"{site.url}/model/card.json" in links
    for link in links:
        assert studio.page.request.get(link).ok
    studio.page.keyboard.press("Escape")
    for tab, hidden in (("Files", "#mesh-file"), ("Path", "#download-animation")):
        studio.tab(tab)
        assert not studio[hidden].is_visible()
        assert studio[f"#tab-{tab.lower()} .files-only"].is_visible()


def test_a_file_keeps_materials_seams_and_edges(tmp_path: Path, site: Site, window: Open) -> None:
    model = load(dressed(tmp_path, png()) / "dressed")
    code = model.latents.codes([[0.1, 1, 0.5]])[0][0]
    vertices, surface = model.shape(code).vertices, model.decoder.surface(MeshChoice.FINE)
    assert surface is not None
    reference, expected = (
        MESH_FORMATS["glb"].encode(positions, model.faces, None, surface) for positions in (model.vertices, vertices)
    )
    studio = window(site.url)
    studio.page.goto(f"{site.url}/index.html")
    script = """async ([glb, positions]) => {
        const { withPositions } = await import(new URL("page/js/static/glb.js", document.baseURI));
        const file = withPositions(Uint8Array.from(glb).buffer, Float32Array.from(positions));
        return Array.from(file);
    }"""
    written = bytes(studio.page.evaluate(script, [[*reference], vertices.ravel().tolist()]))
    start = 20 + int.from_bytes(written[12:16], "little") + 8
    begin = 20 + int.from_bytes(expected[12:16], "little") + 8
    body = np.frombuffer(written[start:], "u1"), np.frombuffer(expected[begin:], "u1")
    assert body[0].shape == body[1].shape
    numbers = 6 * len(surface.split.vertex)
    found, wanted = (np.frombuffer(each.tobytes()[: 4 * numbers], "<f4") for each in body)
    assert np.allclose(found, wanted, atol=1e-5)
    assert np.array_equal(body[0][4 * numbers :], body[1][4 * numbers :])
    assert np.allclose(read_arrays(written, "glb")[0], vertices, atol=1e-5)


def test_a_phone_computes_drafts_itself(server: Server, window: Open) -> None:
    studio = window(has_touch=True, is_mobile=True).open("#model=figure")
    studio.eventually(lambda: any("decoder.onnx" in address for address in studio.addresses))
    values = cycle(np.linspace(0.01, 0.5, 50))

    def is_near() -> bool:  # until the decoder has arrived, the server is asked
        studio.asked.clear()
        studio.slide(0, value := float(next(values)))

        def qualities() -> list[str]:
            return [asked["quality"] for asked in studio.asked if abs(asked["latents"][0][0] - value) < 1e-6]

        studio.eventually(lambda: "full" in qualities())
        return "draft" not in qualities()

    studio.eventually(is_near)
    studio.rest()


def test_the_graph_is_answered_once(server: Server) -> None:
    with httpx.Client(base_url=server.url, timeout=60) as client:
        address = client.get("/v1/models/figure").json()["links"]["decoder"]
        answer = client.get(address)
        assert answer.content == (ROOT / "models" / "figure" / "4" / "decoder.onnx").read_bytes()
        assert client.get(address, headers={"If-None-Match": answer.headers["ETag"]}).status_code == 304
        assert "decoder" not in client.get("/v1/models/with-fine").json()["links"]
        missing = client.get("/v1/models/with-fine/decoder.onnx")
    assert missing.status_code == 404
    assert "with-fine has no decoder.onnx" in missing.json()["detail"]


def test_the_runtime_is_the_file_that_its_source_names() -> None:
    folder = PAGE / "vendor" / "onnxruntime"
    packed = gzip.decompress((folder / "ort-wasm-simd-threaded.wasm.gz").read_bytes())
    assert hashlib.sha256(packed).hexdigest() in (folder / "README.md").read_text()
