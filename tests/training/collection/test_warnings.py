"""Warnings about wrong shapes among good ones: each is named with what is wrong, and no good shape is."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shapespace.files.formats import MESH_FORMATS
from shapespace.training.collection import large_arrays
from shapespace.training.collection.faults import IngestError
from shapespace.training.collection.generators import figure
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.mesh_collection import MeshCollection
from tests.training.whole_runs.conftest import bars

SHAPES, FACES = bars(12)
ODD = 4


def write(folder: Path, shapes: np.ndarray, faces: np.ndarray = FACES, format: str = "npz") -> MeshCollection:
    folder.mkdir(exist_ok=True)
    for k, vertices in enumerate(shapes):
        (folder / f"bar{k}.{format}").write_bytes(MESH_FORMATS[format].encode(vertices, faces))
    return read_collection(folder)


def exchanged(shape: np.ndarray, count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    chosen = rng.choice(len(shape), count, replace=False)
    result = shape.copy()
    result[chosen] = shape[np.roll(chosen, 1)]
    return result


def far_off(shape: np.ndarray) -> np.ndarray:
    result = shape.copy()
    result[77] += [0, 0, 5000]
    return result


UPRIGHT = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
#: A change of one shape, what the message says of it, and whether it stops a run.
ODDITIES: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str, bool]] = {
    "millimetres": (lambda shape: 1000 * shape, r"another size: its lengths are (1,0|9)\d+ times the median", True),
    "a tenth": (lambda shape: shape / 10, r"another size: its lengths are 0\.(1|09)\d* times the median", True),
    "another order": (lambda shape: exchanged(shape, len(shape)), "has its vertices in another order", True),
    "another order and unit": (lambda shape: 1000 * exchanged(shape, 696), "has its vertices in another order", True),
    "60 in another order": (lambda shape: exchanged(shape, 60), "has some vertices in another order", True),
    "a vertex far off": (far_off, r"has a vertex far off the surface: 77 \(counted from 0\)", False),
    "axes exchanged": (lambda shape: shape @ UPRIGHT, "is rotated", False),
    "a duplicate": (lambda shape: SHAPES[2], r"is the same shape as bar2\.npz", False),
}


@pytest.mark.parametrize("oddity", ODDITIES)
def test_an_odd_shape_is_named_and_no_other(oddity: str, tmp_path: Path) -> None:
    change, says, grave = ODDITIES[oddity]
    shapes = SHAPES.copy()
    shapes[ODD] = change(SHAPES[ODD])
    found = write(tmp_path / "meshes", shapes)
    (warning,) = found.warnings
    assert (found.names[warning.shape], warning.grave) == (f"bar{ODD}", grave)
    assert warning.sentence.startswith(f"{tmp_path / 'meshes' / f'bar{ODD}.npz'}: ")
    assert re.search(says, warning.sentence)
    if not grave:
        found.require_accepted([])
        return
    with pytest.raises(IngestError, match=f"--accept bar{ODD}$") as refusal:
        found.require_accepted(["bar1.npz"])
    assert warning.sentence in str(refusal.value)
    for name in (f"bar{ODD}", f"bar{ODD}.npz", f"meshes/bar{ODD}.npz"):
        found.require_accepted([name])
    with pytest.raises(IngestError, match="no shape is called bar77"):
        found.require_accepted([f"bar{ODD}", "bar77.npz"])


def test_a_mirrored_sheet_is_named(tmp_path: Path) -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(0, 1, 9), indexing="ij"))
    corner = np.arange(81).reshape(9, 9)[:-1, :-1].ravel()
    faces = np.concatenate([corner[:, None] + [0, 9, 10], corner[:, None] + [0, 10, 1]])
    shapes = np.stack([[x, y, 0.3 * x**2 + 0.4 * x * y + k * 0.02 * y**2] for k in range(5)]).swapaxes(1, 2)
    assert not write(tmp_path / "meshes", shapes, faces).warnings
    shapes[3] *= [-1, 1, 1]
    (warning,) = write(tmp_path / "meshes", shapes, faces).warnings
    assert (warning.shape, warning.grave) == (3, False)
    assert "is a mirror image" in warning.sentence


@pytest.mark.parametrize("format", ["obj", "ply"])
def test_vertices_are_numbered_as_in_the_file(format: str, tmp_path: Path) -> None:
    # Two vertices that no face uses come first.
    shapes = np.concatenate([np.zeros((len(SHAPES), 2, 3)), SHAPES], axis=1)
    shapes[ODD, 2:] = far_off(SHAPES[ODD])
    (warning,) = write(tmp_path / "meshes", shapes, FACES + 2, format).warnings
    assert f": {79 + (format == 'obj')} (counted from {int(format == 'obj')})" in warning.sentence


def test_shapes_that_only_differ_are_not_odd(tmp_path: Path) -> None:
    _, vertices, faces = figure.poses(24)
    assert not write(tmp_path / "figure", vertices, faces).warnings
    grown = SHAPES * np.linspace(0.8, 1.25, len(SHAPES))[:, None, None]
    assert not write(tmp_path / "grown", grown).warnings
    rolled = SHAPES.copy()
    x, y, z = ((SHAPES[0] - [1000, 0, 0]) / [100, 1, 1]).T
    rolled[ODD] = np.stack([(150 + z) * np.sin(x / 1.5), y, (150 + z) * np.cos(x / 1.5)], axis=1)
    assert not write(tmp_path / "rolled", rolled).warnings


def test_a_collection_beyond_memory_is_read_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shapes = SHAPES.copy()
    shapes[ODD] = far_off(SHAPES[ODD])
    before = write(tmp_path / "meshes", shapes)
    monkeypatch.setattr(large_arrays, "IN_MEMORY", 1000)
    monkeypatch.setattr(large_arrays, "TOGETHER", 20 * len(shapes))
    found = read_collection(tmp_path / "meshes")
    assert isinstance(found.vertices, np.memmap)
    np.testing.assert_array_equal(found.vertices, before.vertices)
    assert len(found.warnings) == 1
    assert (found.names, found.central, found.warnings) == (before.names, before.central, before.warnings)


def test_the_most_central_shape_is_the_reference_wherever_it_stands(tmp_path: Path) -> None:
    shapes = np.stack([SHAPES[0] + (SHAPES[1] - SHAPES[0]) * t for t in (0, 2, 0.9, 1.2, 0.7)])
    shapes[2] = shapes[2] @ UPRIGHT + [0, 5e3, 0]
    found = write(tmp_path / "meshes", shapes)
    assert found.central == found.index(None) == 2
    assert found.index("bar0") == 0


def test_parts_that_almost_meet_are_told_from_separate_ones(tmp_path: Path) -> None:
    # The faces of one half get copies of the vertices along the seam.
    left = SHAPES[0][FACES].mean(axis=1)[:, 0] < 1000
    seam = np.intersect1d(FACES[left], FACES[~left])
    twin = np.arange(SHAPES.shape[1])
    twin[seam] = SHAPES.shape[1] + np.arange(len(seam))
    faces = np.where(left[:, None], FACES, twin[FACES])
    size = np.linalg.norm(np.ptp(SHAPES[0], axis=0))
    for distance, says in ((2e-5, "4 parts that almost meet"), (0.1, "4 separate parts")):
        shapes = np.concatenate([SHAPES[:4], SHAPES[:4, seam] + [0, 0, distance * size]], axis=1)
        with pytest.raises(IngestError, match=says) as refusal:
            write(tmp_path / "meshes", shapes, faces)
        assert ("merge" in str(refusal.value)) == (distance < 1e-3)


def test_a_file_s_name_may_have_braces(tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    write(folder, SHAPES[:4], format="obj")
    (folder / "bar0.obj").rename(folder / "a{face}{0}.obj")
    lines = (folder / "bar3.obj").read_text().splitlines()
    last = lines[-1].split()
    (folder / "bar3.obj").write_text("\n".join([*lines[:-1], " ".join([last[0], *last[2:], last[1]]), ""]))
    with pytest.raises(IngestError, match=r"bar3\.obj: face \d+ joins vertices .* but in a\{face\}\{0\}\.obj"):
        read_collection(folder)


def test_a_file_s_name_is_on_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    write(folder, np.stack([*SHAPES[:3], SHAPES[2]]), format="obj")
    (folder / "bar3.obj").rename(folder / "two\nlines.obj")
    (warning,) = read_collection(folder).warnings
    assert r"two\nlines.obj: is the same shape" in warning.sentence


@pytest.mark.parametrize("name", ["bar0.obj", "bar3.obj"])
@pytest.mark.parametrize(
    ("keep", "says"),
    [(0.3, "cut short"), (0.8, "cut short"), ("line", "seems to be cut short.*or else export")],
)
def test_an_obj_file_that_lacks_its_end_is_called_that(name: str, keep: float | str, says: str, tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    write(folder, SHAPES[:4], format="obj")
    data = (folder / name).read_bytes()
    lines = data.splitlines(keepends=True)
    short = b"".join(lines[: len(lines) - 100]) if keep == "line" else data[: int(float(keep) * len(data))]
    (folder / name).write_bytes(short)
    with pytest.raises(IngestError, match=f"{name}: .*{says}"):
        read_collection(folder)
