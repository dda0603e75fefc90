"""The command ``init``: write a commented configuration for a folder of meshes, with values chosen from the meshes."""

from __future__ import annotations

import json
import os
import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from shapespace.files.limits import in_words
from shapespace.training.collection.groups import SUBJECT, subjects_repeat
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.mesh_collection import MeshCollection
from shapespace.training.runs.config import ConfigError
from shapespace.training.runs.network_settings import CombinerSettings, LatentNetworkSettings
from shapespace.training.runs.settings import (
    NEARLY_COARSE,
    CollectionSettings,
    ExponentialSettings,
    MaterialSettings,
    ModeSettings,
    SampleSettings,
)

TEMPLATE = """\
# {title}: {shapes} shapes with {vertices} vertices and {faces} faces.
# A line such as "# seed = 0" shows a default. To change it, remove the # and edit the value.

[collection]
data = {data}    # folder of meshes, one NPZ, or one GLB with morph targets; relative to this file
{file}# Served shapes have the position and orientation of the reference. By default it is {reference}, the most central
# shape. To choose another shape: reference = {other}
{coarse}{parts}
# mirror = true    # if one shape is symmetric, learn from the mirror images of all shapes too
{related}

[material]
# eta = {material.eta:g}    # resistance to bending against stretching; with large values, triangles may collapse

[exponential]
# first_step = "{exponential.first_step}"    # how a geodesic begins; "paper" needs far more time steps to be as exact

[modes]
geometry = "auto"    # "exponential" bends; "vertices", "nric", "differential" are straight lines and fast; or "auto"
# count = "{mode.count}"    # how many numbers describe a shape; a number that you choose is at most {most}
# norm = "{mode.norm}"    # how errors of modes are measured; "shell", as in the paper, gives larger vertex errors

[factors]
# count = 4    # groups of modes, each with its own network; by default chosen from the overlap of the modes

[samples]
# count = {sample.count}    # shapes to compute and learn from, most of a run's time; a tenth is enough for a first try
# seed = {sample.seed}    # another number draws other random shapes

[networks.factors]
# hidden = {factor.hidden}    # layers of each factor's network; make them wider if the report shows a low R² of factors

[networks.combiner]
# correction = {{ kind = "{combiner.correction.kind}" }}    # how the factors are joined; or "kernel", "convolutions", …

[export]
name = {name}    # used in addresses and file names: small letters, digits and hyphens
title = {title}    # shown to people
description = {description}
licence = "unspecified"    # licence of the meshes, and so of the model: fill it in before you share the bundle
"""


#: What a configuration says where not all parts can be kept.
_PARTS_ALONE = (
    "# The model can't keep all parts, so it keeps only the largest; of equally large parts, the first in the file.",
    "# You may name another part, or several: up to a hundred parts that are small or rigid can be attached.",
)


def configuration(
    collection: MeshCollection, data: str, title: str, parts: Sequence[str] = (), file: str | None = None
) -> str:
    """Return the TOML text of a collection's configuration.

    Args:
        collection: the meshes.
        data: the meshes' path in the configuration.
        title: the model's title; the bundle's name is made from it.
        parts: names of the parts to keep, if they are chosen.
        file: name of the file that is read from each folder, if any.
    """
    count, vertices = collection.vertices.shape[:2]
    target = CollectionSettings().coarse_vertices
    coarse = (
        f"coarse_vertices = {target}    # vertices to compute with; more take longer, 0 takes all {vertices}"
        if vertices > NEARLY_COARSE * target
        else f"# coarse_vertices = {target}    # meshes with over 1.5 times as many vertices are simplified"
    )
    return TEMPLATE.format(
        shapes=count,
        vertices=vertices,
        faces=len(collection.faces),
        data=_string(data),
        reference=_string(collection.names[collection.central]),
        other=_string(collection.names[0]),
        related=_related(collection.names),
        coarse=coarse,
        parts=_parts(collection, parts),
        file=f"file = {_string(file)}    # file to read from each folder in data, which names the shape\n"
        if file
        else "",
        material=MaterialSettings(),
        exponential=ExponentialSettings(),
        most=count - 1,
        mode=ModeSettings(),
        sample=SampleSettings(),
        factor=LatentNetworkSettings(),
        combiner=CombinerSettings(),
        name=_string(slug(title)),
        title=_string(title),
        description=_string(f"Learned from {count} shapes."),
    )


def _related(names: Sequence[str]) -> str:
    """Return the setting ``related`` where subjects have several shapes, or else how to set it."""
    setting = f"related = '{SUBJECT}'"
    if subjects_repeat(names):
        return f"{setting}    # scans of the same subject are left out together to measure errors"
    return f"# Several scans of a patient are related. To leave them out together where errors are measured: {setting}"


def _parts(collection: MeshCollection, chosen: Sequence[str]) -> str:
    """Return the setting ``parts``, active if not all are kept, and a list of all parts."""
    if not collection.part_sizes:
        return ""
    kept = [collection.kept_alone] if collection.kept_alone else list(chosen)
    every = list(dict.fromkeys(part.name for part in collection.parts))
    names = ", ".join(_string(name) for name in kept or every)
    what = "the model predicts the first part and attaches the others named here; all other parts are left out"
    lines = [f"{'' if kept else '# '}parts = [{names}]    # {what}", *_PARTS_ALONE[: 2 * bool(collection.kept_alone)]]
    lines.append("# All parts, with their shares of the area:")
    quoted = [_string(size.own) for size in collection.part_sizes]
    width = max(map(len, quoted))
    sizes = zip(quoted, collection.part_sizes, strict=True)
    lines += [f"#   {name:{width}} {size.vertices:8} vertices {size.area:8.1%}" for name, size in sizes]
    return "\n" + "\n".join(lines)


def write(
    meshes: Path,
    out: Path | None = None,
    *,
    force: bool = False,
    parts: Sequence[str] = (),
    file: str | None = None,
) -> tuple[Path, MeshCollection]:
    """Read a collection and write its configuration, by default into the working directory under the collection's name.

    Without names of ``parts``, the largest part is kept alone where not all can be kept. ``file`` is the name of the
    file to read from each folder in ``meshes``, if any.

    Raises:
        IngestError: the collection can't be used.
        ConfigError: the meshes are a configuration, the file exists and ``force`` isn't set, or it can't be written.
    """
    full = meshes.resolve()
    title = (full.stem if full.is_file() else full.name) or "shapes"
    if full.is_file() and full.suffix == ".toml":
        raise ConfigError(f"{meshes}: is a configuration, from which run trains; init needs a folder of meshes")
    out = out or Path(f"{title}.toml")
    if out.exists() and not force:
        raise ConfigError(f"{out}: exists already; --force replaces it, --out FILE.toml writes another file")
    collection = read_collection(meshes, parts, file, alone=True)
    data = Path(os.path.relpath(full, out.parent.resolve())).as_posix()
    try:
        out.write_bytes(configuration(collection, data, title, parts, file).encode())
    except OSError as error:
        raise ConfigError(f"{out}: can't be written: {in_words(error, named=False)}") from error
    except UnicodeEncodeError as error:
        raise ConfigError(
            f"{out}: can't be written: a name in it is not valid UTF-8; rename the folder or its files"
        ) from error
    return out, collection


def slug(title: str) -> str:
    """Make a bundle's name from any text: small letters, digits and hyphens."""
    plain = unicodedata.normalize("NFKD", title).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", plain).strip("-") or "shapes"


def _string(text: str) -> str:
    # A JSON string is also a TOML string, except for DEL.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
