"""docs/reference has everything that the code reads, writes or answers, and nothing else."""

import json
import re
from pathlib import Path
from typing import Any

import click

from shapespace.__main__ import PROGRAM
from shapespace.bundle.schema import ARRAYS, MANIFEST, Manifest
from shapespace.files.formats import MESH_FORMATS, USD_FORMATS, VTK_FORMATS
from shapespace.files.reading import SCAN_FORMATS
from shapespace.training.runs.directory import RunDirectory, RunFile

ROOT = Path(__file__).parents[1]


def page(name: str) -> str:
    return (ROOT / "docs" / "reference" / f"{name}.md").read_text(encoding="utf-8")


def first_cells(text: str) -> set[str]:
    """All text in backquotes in the first columns of tables, and before the colons of lists."""
    rows = re.findall(r"^(?:\| (`[^|]*) \||- (`[^:]*`)[^:`]*: )", text, re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`([^`]+)`", "".join(row))}


def test_every_member_and_array_of_a_bundle() -> None:
    text = page("bundle")
    files, rest = text.split("## The manifest")
    manifest, arrays = rest.split("## The arrays")
    assert first_cells(manifest) == {field.alias or name for name, field in Manifest.model_fields.items()}
    assert first_cells(arrays) == set(ARRAYS)
    bundled = {re.sub(r"\d+", "J", path.name) for path in (ROOT / "models").glob("*/*/*")}
    assert bundled | {MANIFEST} <= first_cells(files)


def test_every_file_of_a_run_directory() -> None:
    run = RunDirectory(Path("RUN"))
    files: list[Any] = [
        getattr(run, name) for name, member in vars(RunDirectory).items() if isinstance(member, RunFile)
    ]
    files += [run.stamp("STAGE"), run.factor_samples(0), run.network("NAME")]
    names = {str(getattr(file, "path", file)).removeprefix("RUN/").replace("factor-0", "factor-J") for file in files}
    table = page("run-directory").split("\n## ")[0]
    assert {name.rstrip("/") for name in first_cells(table)} == names


def test_every_option_of_every_command() -> None:
    for section in page("command").split("\n## ")[1:]:
        title, text = section.split("\n", 1)
        if commands := [PROGRAM.commands[name] for name in title.split(", ") if name in PROGRAM.commands]:
            contexts = [click.Context(command, **command.context_settings) for command in commands]
            options = [option for context in contexts for option in context.command.get_params(context)]
            names = {name for option in options for name in option.opts if name.startswith("--")}
            assert {name.split()[0] for name in first_cells(text)} == names - {"--help", "--version"}, title
    assert first_cells(page("command").split("\n## ")[0]) == {*PROGRAM.commands}


def test_every_call() -> None:
    text = page("http")
    told = {re.split(r"[ ?]", call)[1] for call in first_cells(text) if re.match(r"(GET|POST) ", call)}
    paths = json.loads((ROOT / "openapi" / "openapi.json").read_text(encoding="utf-8"))["paths"]
    assert "/v2/models/{name}/versions/{version}" in text
    assert told == {path.replace("/versions/{version}", "") for path in paths}


def test_every_format() -> None:
    text = page("http") + page("files")
    for name in {*MESH_FORMATS, *USD_FORMATS, *VTK_FORMATS, *SCAN_FORMATS}:
        assert re.search(rf"\b{name}\b", text, re.IGNORECASE), name


#: Tests in tests/shapespace/files of what is read of each format.
DIALECTS = {
    "obj": "test_dialects test_recognition test_polygon_reading test_attributes",
    "off": "test_dialects",
    "stl": "test_dialects",
    "ply": "test_dialects test_polygon_reading",
    "glb": "test_gltf_pose test_gltf_reading test_morph_shapes",
    "npz": "test_formats test_archives",
    "vtk": "test_vtk",
    "vtp": "test_vtk",
    "vtu": "test_vtk",
    "xyz": "test_point_clouds",
    "pts": "test_point_clouds",
    "csv": "test_point_clouds",
    "txt": "test_point_clouds",
    "pcd": "test_point_clouds",
}


def test_every_format_that_is_read_has_an_item_and_a_test_of_its_dialects() -> None:
    items = page("files").split("## Dialects that are read")[1]
    rows = re.findall(r"^- ([^:]+):", items, re.MULTILINE)
    assert {name.lower() for row in rows for name in re.findall("[A-Z]{3}", row)} >= DIALECTS.keys()
    assert SCAN_FORMATS.keys() - {"gltf"} == DIALECTS.keys()
    for names in DIALECTS.values():
        assert all((ROOT / "tests" / "shapespace" / "files" / f"{name}.py").is_file() for name in names.split())
