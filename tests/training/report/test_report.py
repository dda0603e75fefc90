"""The report of an artificial run: what it shows, what it omits, and that its pictures aren't empty."""

import base64
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from shapespace.mesh.triangle_mesh import TriangleMesh, vertex_normals
from shapespace.training.report.number_format import duration
from shapespace.training.report.page import write_report
from shapespace.training.report.record import Record, ReportError
from shapespace.training.report.rendering import Camera
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.stages.run import STAGES
from tests.training.conftest import Said

NASTY = "<script>alert('thumb')</script>"
SECTIONS = {
    "verdict",
    "random",
    "nearness",
    "shapes",
    "modes",
    "factors",
    "strip",
    "tests",
    "figures",
    "losses",
    "stages",
    "configuration",
}
CONFIG = '[collection]\n[modes]\ncount = 4\n[export]\ntitle = "Sphere & Co <b>"\ndescription = "Made up."\n'
VOID = {"br", "hr", "img", "input", "link", "meta"}


def ellipsoid() -> TriangleMesh:
    """An ellipsoid of unit area, thinnest along z."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = TriangleMesh.from_arrays(ball.vertices * [1.0, 1.4, 0.7], ball.faces)
    return mesh.with_vertices(mesh.vertices / np.sqrt(mesh.area))


def score(total: float) -> dict[str, float]:
    return {"total": total, "lengths": total + 0.001, "angles": total - 0.1}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "made-up"
    mesh, rng = ellipsoid(), np.random.default_rng(0)
    x, faces, m = mesh.vertices, mesh.faces, 4
    normals = vertex_normals(x, faces)
    bumps = np.exp(-((x[None] - x[rng.choice(len(x), m)][:, None]) ** 2).sum(axis=-1) / 0.01)[..., None] * normals
    tangents = np.tile(np.abs(bumps).sum(axis=-1)[:, mesh.edges].mean(axis=-1), 2)
    shapes = np.array([x, x * [1.3, 1, 1], x * [1, 0.7, 1]])
    (folder / "networks").mkdir(parents=True)
    (folder / "stages").mkdir()
    (folder / "config.toml").write_text(CONFIG)
    np.savez(
        folder / "reference.npz",
        vertices=x, faces=faces, edges=mesh.edges, scale=1.0, fine_vertices=x, fine_faces=faces,
    )  # fmt: skip
    np.savez(folder / "mean.npz", vertices=1.02 * x)
    np.savez(
        folder / "modes.npz",
        nric=tangents, vertices=bumps, coefficients=np.zeros((9, m)), lower=-np.ones(m), upper=np.ones(m),
        localisation=np.full(m, 0.2), pga_nric=tangents[::-1], pga_vertices=bumps[::-1],
        pga_localisation=np.full(m, 0.9), rank=np.arange(m),
    )  # fmt: skip
    np.savez(
        folder / "gallery.npz",
        faces=faces, test_index=[7, 8, 9], test_exact=shapes, test_predicted=1.01 * shapes,
        test_error=np.array([0.001, 0.01, 0.1])[:, None] * (x[:, 1] - x[:, 1].min()),
        random=shapes, strip_joint=shapes, strip_factors=np.array([shapes, shapes[::-1]]),
    )  # fmt: skip
    for name in ("least-general", "least-near"):
        np.savez(folder / f"{name}.npz", given=shapes[1], found=shapes[2])
    losses = [[0.5**k, 0.7**k + 0.1 * (k == 7)] for k in range(8)]
    documents: dict[str, Any] = {
        "modes.json": {
            "modes": m,
            "converged": True,
            "explained": 0.7531,
            "pga_explained": 0.8531,
            "linearised_logarithms": 0,
            "reasons": [""] * 9,
            "history": [
                {"iteration": k, "objective": 2.0**-k, "misfit": 0.0, "penalty": 2.0**-k, "support": 0.1}
                for k in range(5)
            ],
        },
        "factors.json": {"factors": [[0, 1], [2, 3]], "names": ["head", NASTY], "overlap": [[0.4, 0.1], [0.1, 0.5]]},
        "networks/histories.json": {
            stem: {"epoch": 8, "best": 0.1, "history": losses}
            for stem in ("factor-0-abc", "factor-1-abc", "combiner-abc", "combiner-def", "monolithic-abc")
        }
        | {"combiner-fed": {"epoch": 0, "best": None, "history": []}},
        "generalisation.json": {
            "held_out": 3,
            "counts": [2, 4],
            "steps": 8,
            "worst": NASTY,
            "modes": [{"mean": 0.023, "p95": 0.031}, {"mean": 0.0047, "p95": 0.0061}],
            "components": [{"mean": 0.021, "p95": 0.032}, {"mean": 0.0053, "p95": 0.0071}],
            "stuck": 1,
            "not_stuck": {"modes": {"mean": 0.0031, "p95": 0.0041}, "components": {"mean": 0.0052, "p95": 0.0062}},
        },
        "encoded.json": {
            "shapes": 9,
            "outside": [],
            "worst": "pose7",
            "mean": 0.0019,
            "p95": 0.0029,
            "components": {"mean": 0.0018, "p95": 0.0028},
            "modes": {"mean": 0.0037, "p95": 0.0048},
            "remembered": True,
        },
        "evaluation.json": {
            "eta": 0.01,
            "test_samples": 80,
            "r2": {"composite": score(0.9876), "monolithic": score(0.8765), "limit": score(0.8123)},
            "fresh": {"codes": 50, "failed": 1, "r2": {"composite": score(0.6789)}, "steps": score(0.7891)},
            "limit": {
                "steps": 64,
                "codes": 10,
                "composite": {"vertices": {"mean": 0.031, "max": 0.0456}},
                "exponentials": {"r2": score(0.8912), "vertices": {"mean": 0.001, "max": 0.002}},
            },
            "affine_samples": 80,
            "correction": {"kind": "field", "tried": {"kernel": 0.0123, "field": 0.00456}},
            "r2_factors": {"head": score(0.9), NASTY: score(0.8)},
            "compactness": {"modes": 0.9123, "components": 0.9234},
            "specificity": {"modes": 0.0345, "components": 0.0456},
            "variants": {"v": {"title": "without <i>this</i>", "r2": score(0.7)}},
            "vertex_error": {"mean": 0.0123, "max": 0.2, "iterations": 3.5, "status": {"converged": 3}},
            "sizes": {"composite": 12_300_000},
            "times": {"exact": 1.5, "networks": 0.0042, "reconstruction": 0.2},
            "exponentials": 5603,
            "fractions": [
                {
                    "fraction": f,
                    "training_samples": 100,
                    "exponentials": {"composite": 300, "all of factors": 400},
                    "r2": {name: score(0.9 * f) for name in ("composite", "all of factors", "monolithic")},
                }
                for f in (0.2, 0.5)
            ],
            "seeds": [{"seed": 3, "r2": {"composite": score(0.5432), "monolithic": score(0.5)}}],
            "prolongation": {"mean": 0.001, "max": 0.004},
            "surprise": {"deep": 4321},
        },
        **{f"stages/{name}.json": {"key": "k", "seconds": 3.0} for name in STAGES},
    }
    for name, value in documents.items():
        (folder / name).write_text(json.dumps(value))
    return folder


class Page(HTMLParser):
    """Elements of a page; parsing fails if one isn't closed, or is closed in the wrong order."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.words += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def sections(self) -> set[str | None]:
        return {attributes["id"] for attributes in self.all("section")}

    @property
    def pictures(self) -> dict[str, np.ndarray]:
        """Pixels of each picture, by its alternative text."""
        found = {}
        for attributes in self.all("img"):
            head, _, data = (attributes["src"] or "").partition(",")
            assert head == "data:image/webp;base64"
            with Image.open(io.BytesIO(base64.b64decode(data))) as image:
                assert image.size == (int(attributes["width"] or 0), int(attributes["height"] or 0))
                assert attributes["alt"] not in found
                found[attributes["alt"] or ""] = np.asarray(image.convert("RGBA"), dtype=float)
        return found


@pytest.fixture(scope="module", autouse=True)
def small_pictures() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("shapespace.training.report.cards.LARGE", 100)
        patch.setattr("shapespace.training.report.cards.SMALL", 100)
        yield


@pytest.fixture(scope="module")
def page(run: Path) -> Page:
    assert write_report(RunDirectory(run)) == run / "report.html"
    return Page(run / "report.html")


def partial(run: Path, folder: Path, *names: str) -> Page:
    """The page of a run that has only the named files."""
    (folder / "stages").mkdir(parents=True)
    for name in ("config.toml", *names):
        shutil.copy(run / name, folder / name)
    return Page(write_report(RunDirectory(folder)))


def test_every_section_is_there_with_its_figures(page: Page) -> None:
    assert page.sections == SECTIONS
    assert "mean error of 0.47\xa0% of the diagonal, 11\xa0% less than the best simple model (PCA)." in page.words
    for sentence in (
        "fell from 2.3\xa0% to 0.47\xa0%. Try modes.count = 6",
        "Try samples.count = 8000",
        "shapespace serve",
    ):
        assert sentence in page.words
    assert "More shapes" not in page.words
    words = page.words.replace("\N{NO-BREAK SPACE}", " ")
    for said in ("Sphere & Co <b>", "0.9876", "0.8765", "0.7765", "1.2 %", "4.2 ms", "12.3 MB", "without <i>this</i>",
                 "SPGA 0.7531, PGA 0.8531", "a perceptron at every edge. Its error on held-out codes is 0.46 % of",
                 "kernel ridge regression 1.2 %", "49 codes drawn after training", "0.7891",
                 "R² against 64 time steps", "0.8123", "0.8912", "3.1 %",
                 # Figures that the page's code doesn't name.
                 "4,321", "seeds · 0 · r2 · composite · total", "0.5432"):  # fmt: skip
        assert said in words
    labels = {attributes["aria-label"] for attributes in page.all("svg")}
    assert {f"Losses of {name} by epoch" for name in ("head", NASTY, "combiner", "monolithic")} <= labels
    assert {f"{key} of the SPGA by iteration" for key in ("objective", "support")} <= labels
    assert "Localisation by mode, SPGA and PGA" in labels
    assert {"Overlap of the factors", "R² by share of the samples"} <= labels
    assert len(page.pictures) == 2 * 2 + 3 + 2 * 4 + 3 + 3 + 3 + 2 * 3, "all sections but the figures"


def test_the_page_opens_with_how_near_the_space_comes_to_the_shapes_of_the_user(page: Page) -> None:
    assert page.source.index('id="nearness"') < page.source.index("R² of the composite network")
    words = page.words.replace("\N{NO-BREAK SPACE}", " ")
    said = ["3 shapes, left out", "2 coordinates", "0.47 %", "0.61 %", "0.53 %", "pose7"]
    said += ["The search for 1 shape failed", "searches that ended (2)", "0.31 %"]
    said += ["all 9 shapes, encoded", "stores corrections", "modes alone", "0.37 %"]
    said += ["of your shapes (compactness)", "91.23 %", "92.34 %", "nearest of yours (specificity)", "3.5 %", "4.6 %"]
    assert not [each for each in said if each not in words]
    best = re.findall(r'<td class="best">(.*?)</td>', page.source)
    best = [cell.replace("\N{NO-BREAK SPACE}", " ") for cell in best]
    assert best[:8] == ["2.1 %", "0.47 %", "0.31 %", "0.18 %", "0.18 %", "0.9876", "0.9886", "0.8876"]


def test_the_page_asks_nothing_of_the_network_and_runs_nothing(page: Page) -> None:
    assert "http:" not in page.source
    assert "https:" not in page.source
    assert "url(" not in re.sub(r"url\(#\w+\)", "", page.source)
    assert not page.all("script")
    for _, attributes in page.elements:
        for name in ("src", "href", "xlink:href"):
            assert re.match(r"data:|#", attributes.get(name) or "#")
    assert len(page.source) < 5e6


def test_names_are_text_whatever_is_in_them(page: Page) -> None:
    assert NASTY not in page.source
    assert page.words.count(NASTY) >= 3  # a factor, its network's row, a plot of losses
    assert not page.all("b")
    assert f"Losses of {NASTY} by epoch" in {attributes["aria-label"] for attributes in page.all("svg")}


def test_ids_are_used_once_and_found(page: Page) -> None:
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert set(re.findall(r"url\(#(\w+)\)", page.source)) <= set(ids)
    assert {a["xlink:href"][1:] for a in page.all("use") if a["xlink:href"]} <= set(ids)


def test_the_same_run_makes_the_same_page(run: Path, tmp_path: Path) -> None:
    files = ("reference.npz", "mean.npz", "modes.json")
    assert partial(run, tmp_path / "a", *files).source == partial(run, tmp_path / "b", *files).source


def test_pictures_show_something_and_different_shapes_differ(page: Page) -> None:
    pictures = page.pictures
    for alt, pixels in pictures.items():
        covered = pixels[..., 3] > 250
        assert 0.1 < covered.mean() < 0.95, alt
        assert pixels[covered][:, :3].std(axis=0).max() > 8, alt
        assert pixels[0, :, 3].max() == pixels[:, 0, 3].max() == 0, alt  # the border is empty
    for one, other in (("Best test shape, exact", "Median test shape, exact"),
                       *[[f"Mode {i} of SPGA, coloured where it changes the shape" for i in (0, 1)]],
                       ("Where head changes the shape", f"Where {NASTY} changes the shape")):  # fmt: skip
        assert np.abs(pictures[one] - pictures[other]).mean() > 2


def test_errors_go_from_clay_to_red_where_they_are_large(page: Page) -> None:
    def redness(title: str) -> tuple[float, float]:
        pixels = page.pictures[f"{title} test shape of the network, coloured by its error"]
        surplus = np.where(pixels[..., 3] > 250, pixels[..., 0] - pixels[..., 1], np.nan)
        upper, lower = np.array_split(surplus[np.isfinite(surplus).any(axis=1)], 2)
        return float(np.nanmean(upper)), float(np.nanmean(lower))

    assert redness("Worst")[0] > redness("Worst")[1] + 10  # its error grows towards the top
    assert redness("Worst")[0] > redness("Best")[0] + 40  # one scale for all three


def test_supports_are_where_the_tangent_acts(run: Path) -> None:
    record = Record(RunDirectory(run))
    edges = record.reference["edges"]
    tangent = np.zeros((2, 2 * len(edges)))
    tangent[0, 5], tangent[1, len(edges) + 9] = 1, 1
    support = record.supports(tangent)
    for row, edge in zip(support, (5, 9), strict=True):
        np.testing.assert_array_equal(np.flatnonzero(row), edges[edge])


def test_a_run_on_its_way_makes_a_partial_report(run: Path, tmp_path: Path) -> None:
    assert partial(run, tmp_path / "a").sections == {"configuration"}
    page = partial(run, tmp_path / "b", "reference.npz", "factors.json")  # as a generator's run, which has no modes
    assert page.sections == {"shapes", "factors", "configuration"}
    page = partial(run, tmp_path / "c", "reference.npz", "modes.npz", "evaluation.json")
    assert page.sections == {"verdict", "shapes", "modes", "figures", "configuration"}


def test_stages_say_how_far_the_run_is(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    (folder / "stages").mkdir(parents=True)
    shutil.copy(run / "config.toml", folder)
    (folder / "stages" / "ingest.json").write_text('{"key": "k", "seconds": 2.5}')
    (folder / "stages" / "mean.json").write_text('{"key": "k"}')
    (folder / "log.jsonl").write_text('{"event": "progress", "what": "logs", "done": 3, "total": 9}\n{"event": "pro')
    words = Page(write_report(RunDirectory(folder))).words
    assert "mean: begun" in words
    assert "modes: to do" in words
    assert "ingest: " not in words
    assert "logs: 3 of 9" in words


def test_without_its_wheel_the_report_does_without_pictures(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    page = partial(run, tmp_path / "run", "reference.npz", "modes.npz", "factors.json", "evaluation.json")
    assert not page.pictures
    assert "embreex" in page.words
    assert "0.9876" in page.words


@pytest.mark.parametrize(
    ("name", "content"), [("evaluation.json", "{"), ("reference.npz", "no zip"), ("config.toml", "=")]
)
def test_a_broken_file_is_named_in_one_line(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / "config.toml").write_text(CONFIG)
    (tmp_path / name).write_text(content)
    with pytest.raises(ReportError, match=name) as caught:
        write_report(RunDirectory(tmp_path))
    assert "\n" not in str(caught.value)


def test_a_folder_that_is_no_run_is_refused_in_one_line(tmp_path: Path, said: Said) -> None:
    words = said("report", tmp_path, code=1)
    assert words == said.errors
    assert words.startswith(f"shapespace-train: {tmp_path} is not a run directory: it has no config.toml; ")
    assert not list(tmp_path.iterdir())


def test_the_command_says_where_the_page_is(tmp_path: Path, said: Said) -> None:
    (tmp_path / "config.toml").write_text(CONFIG)
    assert said("report", tmp_path) == f"{tmp_path / 'report.html'}\n"


def test_the_report_needs_no_torch(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(CONFIG)
    code = (
        "import pathlib, sys; sys.modules['torch'] = None\n"
        "from shapespace.training.report.page import write_report\n"
        "from shapespace.training.runs.directory import RunDirectory\n"
        f"write_report(RunDirectory(pathlib.Path({str(tmp_path)!r})))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "report.html").is_file()


@pytest.mark.parametrize("thin", [0, 1, 2])
def test_a_camera_sees_all_of_every_shape_from_its_broad_side(thin: int) -> None:
    mesh = ellipsoid()
    x = np.roll(mesh.vertices, thin - 2, axis=1)
    aside = x + np.array([0.5, 0, 0])
    camera = Camera.facing(x, mesh.faces, [x, aside])
    assert np.linalg.det(camera.axes) == pytest.approx(1)
    assert abs(camera.axes[2, thin]) > 0.8
    assert camera.axes[1, 2 if thin == 1 else 1] > 0.9
    for shape in (x, aside):
        pixels = camera.render(shape, mesh.faces, (0.5, 0.5, 0.5), 80)
        assert max(pixels.shape[:2]) == 80
        edges = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
        assert edges[:, 3].max() == 0
        assert (pixels[..., 3] == 255).sum() > 300


def test_light_comes_from_above_on_both_sides_of_a_surface() -> None:
    mesh = ellipsoid()
    camera = Camera.facing(mesh.vertices, mesh.faces)
    for faces in (mesh.faces, mesh.faces[:, ::-1]):
        pixels = camera.render(mesh.vertices, faces, (0.7, 0.7, 0.7), 100).astype(float)
        rows = np.flatnonzero(pixels[..., 3].max(axis=1) == 255)
        seen = np.where(pixels[..., 3] == 255, pixels[..., 0], np.nan)
        assert np.nanmean(seen[rows[: len(rows) // 3]]) > np.nanmean(seen[rows[-len(rows) // 3 :]]) + 10


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0.0042, "4.2 ms"), (0.44429, "444 ms"), (0.99999, "1 s"), (90, "90 s"), (150, "2.5 min"), (9000, "2.5 h"),
     (None, "–"), (float("nan"), "–")],
)  # fmt: skip
def test_durations_come_in_the_unit_that_suits_them(seconds: float | None, said: str) -> None:
    assert duration(seconds).replace("\N{NO-BREAK SPACE}", " ") == said
