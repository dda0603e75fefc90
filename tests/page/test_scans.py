"""Files not in correspondence: scans shown over the shape, verdicts, and undo."""

import json
import re
from dataclasses import dataclass

import httpx
import numpy as np
import pytest
from playwright.sync_api import Route
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray
from shapespace.files.formats import MESH_FORMATS
from shapespace.files.reading import read_arrays
from tests.page.conftest import Visit
from tests.page.studio import PATIENCE, OpenPage, difference
from tests.page.test_operation import AXE, check
from tests.service.conftest import Server

CODE = [0.5 if k % 3 == 0 else -0.3 for k in range(20)]
FIGURE = "#model=figure"


@dataclass(frozen=True)
class Given:
    """A shape of the figure like a scan: rotated, moved, with faces and vertices in random order."""

    vertices: FloatArray
    faces: np.ndarray

    def file(self, name: str, scale: float = 1.0) -> dict[str, object]:
        rng = np.random.default_rng(0)
        order = rng.permutation(len(self.vertices))
        turned = scale * (self.vertices @ Rotation.from_rotvec([0.2, 1.1, 0.3]).as_matrix().T + [3, -1, 2])
        rank = np.argsort(order)
        format = name.rsplit(".", maxsplit=1)[-1]
        if format == "xyz":
            rows = turned[order]
            content = "\n".join(" ".join(map(repr, row)) for row in rows.tolist()).encode()
        else:
            content = MESH_FORMATS[format].encode(turned[order], rng.permutation(rank[self.faces]))
        return {"name": name, "mimeType": "application/octet-stream", "buffer": content}


@pytest.fixture(scope="module")
def given(server: Server) -> Given:
    call = f"{server.url}/v1/models/figure/mesh?latent={','.join(map(str, CODE))}&format=npz"
    return Given(*read_arrays(httpx.get(call, timeout=60).raise_for_status().content, "npz"))


#: Notes all values of the progress bar.
WATCH_PROGRESS = """() => {
    window.shares = [];
    const bar = document.querySelector('#verdict progress');
    const note = () => bar.hasAttribute('value') && window.shares.push(bar.value);
    new MutationObserver((changes) => note()).observe(bar, { attributeFilter: ['value'] });
}"""


def choose(studio: OpenPage, file: object) -> None:
    studio.tab("Files")
    studio["#mesh-file"].set_input_files(file)  # type: ignore[arg-type]


def verdict(studio: OpenPage) -> str:
    return studio["#verdict"].inner_text()


def until_said(studio: OpenPage, text: str) -> str:
    return studio.eventually(lambda: words if text in (words := verdict(studio)) else None)


def ghost(studio: OpenPage) -> float:
    """Share of pixels that the scan changes."""
    box = studio["#ghost"]
    with_it = studio.picture()
    box.uncheck()
    without = studio.until_different(with_it)
    box.check()
    studio.until_different(without)
    return float((np.abs(with_it - without).max(axis=2) > 12).mean())


@pytest.mark.parametrize("name", ["scan.ply", pytest.param("points.xyz", marks=pytest.mark.long)])
def test_a_scan_is_fitted_and_lies_over_its_shape(visit: Visit, given: Given, name: str) -> None:
    studio = visit(FIGURE, complains=name.endswith("ply"))  # the console logs that `encode` refuses it
    start = studio.picture()
    choose(studio, given.file(name))
    words = until_said(studio, f"Figure fits {name}")
    studio.until_code(CODE, 0.12)
    assert "of the diagonal" in words
    assert "100 % of the scan lies on the shape" in words
    studio["#verdict summary"].click()
    assert "in the model's units" in verdict(studio)
    studio.rest()
    studio.page.evaluate(AXE.read_text())
    check(studio, "scan")
    assert ghost(studio) > 0.01
    # The placed points lie on the shape: hardly any is drawn outside its outline.
    shown = studio.picture()
    studio["#ghost"].uncheck()
    alone = studio.until_different(shown)
    paper = np.abs(alone - alone[0, 0]).max(axis=2) < 8
    beside = (np.abs(shown - alone).max(axis=2) > 40) & paper
    assert beside.mean() < 0.004

    studio.page.get_by_role("button", name="Back to my shape").click()
    studio.until_code([0] * 20)
    studio["#to-files"].focus()
    studio.eventually(lambda: difference(start, studio.picture()) < 0.001)
    studio.page.get_by_role("button", name="Show what was found").click()
    studio.until_code(CODE, 0.12)
    studio["#undo"].click()
    studio.until_code([0] * 20)
    studio["#verdict [data-do=close]"].click()
    assert studio["#verdict"].is_hidden()


@pytest.mark.long
def test_how_sure_the_shape_of_a_scan_is_shows_where_it_was_not_seen(visit: Visit, given: Given) -> None:
    studio = visit(FIGURE, complains=True)
    assert studio["#sure"].is_hidden()
    up = given.vertices[:, 1]
    seen = (up > np.quantile(up, 0.25))[given.faces].all(axis=1)  # not the lower legs
    used, index = np.unique(given.faces[seen], return_inverse=True)
    studio.tab("Files")
    studio["#read-as"].select_option("part")
    choose(studio, Given(given.vertices[used], index.reshape(-1, 3)).file("top.ply"))
    until_said(studio, "Figure fits top.ply")
    studio["#ghost"].uncheck()
    studio.tab("Colour")
    studio["[name=colour][value=distance]"].check()
    studio.page.keyboard.press("ArrowDown")
    assert studio["#sure input"].is_checked()
    studio.eventually(lambda: "May be off by" in studio["#legend"].inner_text())
    coloured = studio.picture()
    red, _, blue = np.moveaxis(coloured.astype(int), 2, 0)
    body = np.abs(coloured - coloured[0, 0]).max(axis=2) > 40
    low, high = np.flatnonzero(body.any(axis=1))[[0, -1]]
    legs, top = (slice(high - (high - low) // 5, high), slice(low, low + (high - low) // 3))
    warm = [float((red - blue)[rows][body[rows]].mean()) for rows in (legs, top)]
    assert warm[0] > warm[1] + 40, "the legs, which the scan lacks, are the most uncertain"
    studio.page.evaluate(AXE.read_text())
    check(studio, "certainty")
    assert "spread" not in studio.hash, "an address can't restore the scan"

    studio.tab("Shape")
    studio["#random"].click()
    studio.eventually(studio["#legend"].is_hidden)
    studio.tab("Colour")
    assert studio["[name=colour][value=none]"].is_checked(), "uncertainty is known only for the fitted shape"
    assert studio["#sure"].is_hidden()
    studio.page.get_by_role("button", name="Show what was found").click()
    studio.eventually(studio["#sure"].is_visible)
    studio["#verdict [data-do=close]"].click()
    assert studio["#sure"].is_hidden()


def test_other_units_are_told_and_the_size_is_found(visit: Visit, given: Given) -> None:
    studio = visit(FIGURE, complains=True)
    choose(studio, given.file("millimetres.stl", scale=1000))
    words = until_said(studio, "other units")
    assert "times as large as the shapes of Figure" in words
    assert "scale=" not in words
    assert not any(studio.code)
    studio.page.get_by_role("button", name="Fit it with its own scale").click()
    until_said(studio, "Figure fits millimetres.stl")
    studio.until_code(CODE, 0.12)
    studio["#verdict summary"].click()
    times = verdict(studio).split(" times the model's size")[0].split(" ")[-1]
    assert float(times) == pytest.approx(1000, rel=0.01)


@pytest.mark.long
def test_what_is_no_such_shape_leaves_the_user_their_own(visit: Visit) -> None:
    studio = visit(FIGURE)
    studio.type(4, 0.3)
    mine = [0.3 if k == 4 else 0 for k in range(20)]
    studio.until_code(mine)
    cube = np.random.default_rng(0).uniform(-0.4, 0.4, (3000, 3))
    cube[np.arange(3000), np.arange(3000) % 3] = np.where(np.arange(3000) % 2, -0.4, 0.4)
    content = "\n".join(" ".join(map(repr, row)) for row in cube.tolist()).encode()
    choose(studio, {"name": "cube.xyz", "mimeType": "text/plain", "buffer": content})
    until_said(studio, "cube.xyz is not a shape of this model, or the search failed")
    assert "Your shape stays as it was" in verdict(studio)
    assert studio.code == pytest.approx(mine)
    studio.page.get_by_role("button", name="Show what was found").click()
    studio.eventually(lambda: studio.code != pytest.approx(mine))
    studio.page.get_by_role("button", name="Back to my shape").click()
    studio.until_code(mine)


def test_a_fit_keeps_what_is_locked_and_can_be_given_up(visit: Visit, given: Given) -> None:
    studio = visit(f"{FIGURE}&locked=0,1,2&z={','.join(['0.1'] * 3 + ['0'] * 17)}")
    held: list[Route] = []
    studio.page.route("**/fit?*", lambda route: held.append(route) or None)
    choose(studio, given.file("points.xyz"))
    studio.eventually(lambda: bool(held))
    assert studio["#verdict progress"].is_visible()
    studio.page.get_by_role("button", name="Cancel").click()
    assert studio["#verdict"].is_hidden()
    studio.let_through()
    studio.page.evaluate(WATCH_PROGRESS)
    choose(studio, given.file("points.xyz"))
    studio.eventually(lambda: studio["#verdict"].is_visible() and studio["#verdict progress"].is_hidden())
    shares = studio.page.evaluate("shares")
    assert len(shares) > 3, "the server tells how far it is"
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] < 1
    studio.page.get_by_role("button", name="Show what was found").or_(
        studio.page.get_by_role("button", name="Back to my shape")
    ).first.click()
    assert studio.code[:3] == [0.1] * 3


def test_the_best_fit_at_the_time_limit_is_shown(visit: Visit, given: Given) -> None:
    studio = visit(FIGURE)

    def late(route: Route) -> None:
        answer = route.fetch(timeout=1000 * PATIENCE)
        *shares, found = (json.loads(event.removeprefix("data: ")) for event in answer.text().split("\n\n")[:-1])
        assert [*shares[0]] == ["progress"]
        told = json.dumps(found | {"status": "deadline"})
        route.fulfill(response=answer, body=f"data: {told}\n\n")

    studio.page.route("**/fit?*", late)
    choose(studio, given.file("points.xyz"))
    words = until_said(studio, "The time limit is reached. This is the best fit to points.xyz so far")
    assert "use fewer points" in words
    studio.until_code(CODE, 0.12)


def test_files_that_are_no_shapes_are_refused_in_words_for_people(visit: Visit, given: Given) -> None:
    studio = visit(complains=True)
    files = {
        "letter.docx": (b"PK\x03\x04 nothing to see", "This file type is not supported. Save a mesh as .obj"),
        "notes.txt": (b"Dear reader,\nhello\n", "Export the file again"),
        "empty.obj": (b"", "Export"),
        "list.json": (b'{"a": 1}', "use this file. Export"),
        "flat.xyz": (b"".join(b"%d %d 0\n" % (k % 30, k // 30) for k in range(900)), "lie in a plane"),
    }
    for name, (content, words) in files.items():
        choose(studio, {"name": name, "mimeType": "", "buffer": content})
        message = studio.eventually(lambda: text if name in (text := studio["#messages"].inner_text()) else None)  # noqa: B023
        assert words in message
        assert not re.search(r"[?=]|Content-Type|Send|Ask|JSON", message), message
        assert studio["#verdict"].is_hidden()
        studio["#messages .error button"].first.click()


def test_a_movement_too_small_to_see_is_none_and_a_scan_off_the_shape_is_doubted(visit: Visit) -> None:
    studio = visit()
    script = """async () => {
        const { fitInWords } = await import('/page/js/scan/words.js');
        const far = { mean: 0, p95: 0 };
        const placement = { rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], translation: [3e-5, -2, -1e-9], scale: 1 };
        const answer = { status: 'converged', distances: { scan: far, model: far }, explained: 1, seen: 1, placement };
        const little = { status: 'ambiguous', reason: '9% lie, but the scan says little about a, 0.9% away. Send.' };
        const [sure, doubtful, open] = [{}, { status: 'deadline', explained: 0.2 }, little].map((change) =>
            fitInWords({ ...answer, noise: 0, ...change }, { file: 'a', model: 'b', diagonal: 2 }));
        return [sure.more[0], doubtful.words.at(-1), open.title, open.words.at(-1)];
    }"""
    place, doubt, title, little = studio.page.evaluate(script)
    assert "moved by (0, −2, 0)" in place
    assert "Perhaps it is no shape of this model" in doubt
    assert title == "b fits a, but another shape may fit as well"
    assert little == "9% lie, but the scan says little about a, 0.9% away. If you can, scan more sides."


@pytest.mark.long
def test_a_part_is_fitted_as_a_part(visit: Visit, given: Given) -> None:
    studio = visit(FIGURE)
    front = given.vertices[given.vertices[:, 2] > np.quantile(given.vertices[:, 2], 0.4)]
    studio.tab("Files")
    studio["#read-as"].select_option("a scan of a part, as from one camera")
    asked: list[str] = []
    studio.page.on("request", lambda request: "/fit" in request.url and asked.append(request.url))
    choose(studio, Given(front, given.faces[:0]).file("front.xyz"))
    studio.eventually(lambda: studio["#verdict"].is_visible() and studio["#verdict progress"].is_hidden())
    assert "partial=true" in asked[0]
