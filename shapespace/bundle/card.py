"""The card of a bundle: ``README.md``, with a head of YAML as Hugging Face has it, and a text for people."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from shapespace.bundle.geometry import Geometry
from shapespace.bundle.schema import Manifest
from shapespace.counted import counted

#: Licences that Hugging Face knows by these names. Others are called "other" in the head, with their own name.
_LICENCES = {
    "agpl-3.0", "apache-2.0", "bsd-2-clause", "bsd-3-clause", "cc-by-4.0", "cc-by-nc-4.0", "cc-by-nc-nd-4.0",
    "cc-by-nc-sa-4.0", "cc-by-nd-4.0", "cc-by-sa-4.0", "cc0-1.0", "gpl-2.0", "gpl-3.0", "lgpl-3.0", "mit", "mpl-2.0",
    "odbl", "unlicense",
}  # fmt: skip
_TAGS = ("3d", "mesh", "shape-model", "onnx")


def card(manifest: Manifest, geometry: Geometry) -> bytes:
    """Return the card of a bundle; equal bundles give equal cards."""
    return f"---\n{_head(manifest)}\n---\n\n{_text(manifest, geometry)}\n".encode()


def _head(facts: Manifest) -> str:
    licence = re.sub(r"\s+", "-", facts.licence.strip().lower())
    known = licence in _LICENCES
    head: dict[str, Any] = {"license": licence if known else "other"}
    if not known:
        head["license_name"] = re.sub(r"[^a-z0-9.]+", "-", licence).strip("-") or "unknown"
    head |= {"library_name": "shapespace", "tags": [*_TAGS]}
    named = {
        ("r_squared", "R² of lengths and angles"): _number(facts.figures, "r2", "composite", "total"),
        ("vertex_error", "mean vertex error, share of the diagonal"): _number(facts.figures, "vertex_error", "mean"),
    }
    if measured := [{"type": kind, "name": name, "value": value} for (kind, name), value in named.items() if value]:
        task = {"type": "mesh-generation", "name": "Meshes of codes"}
        data = {"type": "shape-space", "name": "test samples of the shape space"}
        results = [{"task": task, "dataset": data, "metrics": measured}]
        head |= {"metrics": [each["type"] for each in measured]}
        head |= {"model-index": [{"name": facts.name, "results": results}]}
    # JSON is YAML, and quotes whatever stands in a manifest.
    return "\n".join(f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in head.items())


def _text(facts: Manifest, geometry: Geometry) -> str:
    mesh = geometry.fine.reference if geometry.fine else geometry.reference
    code = f'import shapespace\nmodel = shapespace.load("{facts.name}")  # or the path of this folder\n'
    code += "vertices = model.decode(model.sample(1)[0])"
    maker, licence = _line(facts.origin.code_version), _line(facts.licence) or "not given"
    paragraphs = [
        f"# {_line(facts.title or facts.name)}",
        _line(facts.description),
        f"This model turns {counted(facts.latent_dimension, 'number')}, a *code*, into a triangle mesh.",
        f"Each shape has {len(mesh.vertices)} vertices and the same {len(mesh.faces)} faces.",
        "## Use",
        "Install `shapespace[model]`. Then, in Python:",
        f"```python\n{code}\n```",
        f"In the shell, `shapespace decode {facts.name} --random 5 --out shapes` writes five random shapes.",
        "## Codes",
        "Inside these bounds the model was trained.",
        "\n".join(_coordinates(facts)),
        "## Figures",
        "\n".join(f"- {sentence}" for sentence in _figures(facts, geometry)),
        "## Origin",
        f"Version {facts.version} of the model, made by shapespace {maker}. The licence is {licence}.",
    ]
    return "\n\n".join(filter(None, paragraphs))


def _coordinates(facts: Manifest) -> Iterator[str]:
    yield "| number | name | factor | lowest | highest |"
    yield "|---|---|---|---|---|"
    for factor in facts.factors:
        for k in range(factor.start, factor.stop):
            name = _line(facts.latent_names[k]) + (" (an angle)" if facts.period[k] is not None else "")
            yield f"| {k} | {name} | {_line(factor.name)} | {facts.lower[k]:.3g} | {facts.upper[k]:.3g} |"


def _figures(facts: Manifest, geometry: Geometry) -> Iterator[str]:
    if geometry.training_codes is not None:
        yield f"The model learned from {len(geometry.training_codes)} training shapes."
    figures = facts.figures
    found, affine = (_number(figures, "r2", name, "total") for name in ("composite", "affine"))
    if found is not None:
        beside = "" if affine is None else f" A linear combination of the factors has {affine:.4f}."
        yield f"R² of lengths and angles on test samples is {found:.5f}.{beside}"
    if (error := _number(figures, "vertex_error", "mean")) is not None:
        yield f"The mean vertex error on test samples is {100 * error:.2g} % of the bounding-box diagonal."
    modes, components = (_number(figures, "generalisation", name, -1, "mean") for name in ("modes", "components"))
    if modes is not None and components is not None:
        yield (
            f"On training shapes that were left out, the mean vertex error is {100 * modes:.2g} % of the diagonal. "
            f"Principal components have {100 * components:.2g} %."
        )
    yield "`manifest.json` has all figures."


def _number(figures: Mapping[str, Any], *path: str | int) -> float | None:
    """Return a figure, or None if it is missing or has another form."""
    found: Any = figures
    for name in path:
        try:
            found = found[name]
        except (KeyError, IndexError, TypeError):
            return None
    return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None


def _line(text: str) -> str:
    """Return text of a manifest on one line, without marks that tables and code end at."""
    return " ".join(text.split()).replace("|", "\\|").replace("`", "'")
