"""The command ``page``: a model as static files that show it in a browser."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np

from shapespace.command_line import FileOrFolder, near
from shapespace.commands.parameters import FORCE, MODEL, UnusableOutputError, command, require_new, write
from shapespace.files.formats import MESH_FORMATS
from shapespace.files.npz import npz_bytes
from shapespace.files.poster import poster
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Distribution
from shapespace.model.shape_model import ShapeModel, load
from shapespace.page_scripts import PAGE, joined_scripts

#: Number of random codes of each distribution, one for each seed from 0.
SEEDS = 1000
#: Members of a manifest that the page does not show.
_UNSEEN = {"combiner", "decoder", "files", "geometry", "onnx_tolerance", "origin", "start", "without_decoder"}

PARAMS = (
    MODEL,
    click.Option(
        ["--out"], type=FileOrFolder(standard=False), required=True, metavar="FOLDER", help="folder for the files"
    ),
    FORCE,
)


@command
def page(model: str, out: Path, force: bool) -> int:
    """Write a page that shows a model without a server; return 0."""
    if out.exists() and not out.is_dir():
        raise UnusableOutputError(f"{out} is a file; name a folder")
    loaded = load(model)
    files = {**dict(_page()), **_model(loaded)}
    require_new((out / name for name in files), force=force)
    for name, content in files.items():
        write(out / name, content)
    size = sum(map(len, files.values())) / 1e6
    print(f"{near(out)}: {len(files)} files, {size:.1f} MB. Any web server can show them, such as", file=sys.stderr)
    print(f"python -m http.server 8080 --bind 127.0.0.1 --directory {near(out)}", file=sys.stderr)
    return 0


def _page() -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of the page, which asks the files of the model instead of a server."""
    for path in sorted(PAGE.rglob("*")):
        if path.is_file() and path != PAGE / "index.html":
            yield f"page/{path.relative_to(PAGE).as_posix()}", path.read_bytes()
    for name, content in joined_scripts(instead={"server/api.js": "static/api.js"}).items():
        yield f"page/{name}", content
    text = (PAGE / "index.html").read_text("utf-8")
    for old, new in (
        ('<html lang="en">', '<html lang="en" class="static">'),
        ('href: "v1/models"', 'href: "model/card.json"'),
    ):
        if text.count(old) != 1:
            raise RuntimeError(f"the page has {old!r} {text.count(old)} times")
        text = text.replace(old, new)
    yield "index.html", text.encode()


def _model(model: ShapeModel) -> dict[str, bytes]:
    """Return names and contents of the model's files; raises UnusableOutputError if it has no decoder."""
    facts = model.manifest
    if facts.decoder is None:
        why = facts.without_decoder or "the bundle is older than version 0.3"
        raise UnusableOutputError(
            f"{facts.name} has no decoder.onnx, which computes shapes in the browser ({why}): "
            f"`shapespace export {model.folder}` adds it"
        )
    reference = model.vertices
    home = np.where((model.lower <= 0) & (model.upper >= 0), 0, (model.lower + model.upper) / 2)
    (code,), _ = model.latents.codes([home.tolist()])
    meshes = {"vertices": reference, "faces": model.faces, "home": model.shape(code).vertices}
    codes = {
        each.value: np.concatenate([model.sample(1, seed, each) for seed in range(SEEDS)])
        for each in (Distribution.POPULATION, Distribution.UNIFORM)
    }
    surface = model.decoder.surface(MeshChoice.FINE)
    return {
        "model/card.json": json.dumps(_card(model), ensure_ascii=False, allow_nan=False).encode(),
        "model/meshes.npz": _narrow(meshes),
        "model/codes.npz": _narrow(codes),
        "model/reference.glb": MESH_FORMATS["glb"].encode(reference, model.faces, None, surface),
        "model/poster.svg": poster(model.reference),
        "model/decoder.onnx": (model.folder / facts.decoder.file).read_bytes(),
    }


def _narrow(arrays: Mapping[str, np.ndarray]) -> bytes:
    return npz_bytes({name: np.asarray(array, "<i4" if name == "faces" else "<f4") for name, array in arrays.items()})


def _card(model: ShapeModel) -> dict[str, Any]:
    """Return what the page shows of a model, in the members of the server's card."""
    facts = model.manifest.model_dump(mode="json", by_alias=True, exclude=_UNSEEN)
    facts |= {"vertices": len(model.vertices), "faces": len(model.faces), "draft_error": None}
    figures = facts["figures"]
    facts |= {"digest": model.digest, "links": {"self": "model/card.json", "mesh": ""}}
    return facts | {"specificity": figures.get("specificity"), "generalisation": _generalisation(figures)}


def _generalisation(figures: Mapping[str, Any]) -> dict[str, Any] | None:
    found = figures.get("generalisation")
    try:
        return found and {"mean": found["modes"][-1]["mean"], "components": found["components"][-1]}
    except (KeyError, IndexError, TypeError):
        return None
