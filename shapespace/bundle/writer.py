"""Writer of bundles. It writes a whole bundle or nothing."""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.bundle.attributes import surface_entry
from shapespace.bundle.card import card
from shapespace.bundle.geometry import Geometry
from shapespace.bundle.reader import BundleError, read_bundle, read_files
from shapespace.bundle.schema import (
    CARD,
    COMBINER,
    DECODER,
    GEOMETRY,
    MANIFEST,
    SCHEMA_VERSION,
    START,
    AutoError,
    DecoderEntry,
    DraftError,
    FileEntry,
    Manifest,
    Origin,
    Tolerance,
    factor_network,
)
from shapespace.files.atomic import replaced_folder, synced_file
from shapespace.files.limits import clipped
from shapespace.files.npz import npz_bytes
from shapespace.shell.energy import Material
from shapespace.shell.space import FirstStep


@dataclass(frozen=True)
class ExportedDecoder:
    """Content and entry of ``decoder.onnx``, or the reason why a bundle has none."""

    content: bytes | None
    entry: DecoderEntry | None
    absent: str | None = None


@dataclass(frozen=True, kw_only=True)
class Networks:
    """Contents of the ONNX files of a bundle. Their batch size n is dynamic."""

    factors: Sequence[bytes]  # network ψ_j of each factor: latents of the factor to lengths and angles (n, 2E)
    combiner: bytes  # lengths and angles of all factors (n, J, 2E) to lengths and angles (n, 2E)
    start: bytes | None = None  # latents (n, m) to start vertices (n, V, 3) of Gauss–Newton; optional
    decoder: ExportedDecoder | None = None  # latents to the vertices of drafts; optional


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Members of a manifest that do not follow from the files of the bundle; see `schema.Manifest`.

    Factors are names with the consecutive indices of their latents. Bounds and periods are (m,) arrays, NaN where there
    is no period. One unit of the reference has length ``scale`` in the user's units.
    """

    name: str
    version: str
    licence: str
    title: str
    description: str
    latent_names: Sequence[str]
    factors: Mapping[str, Sequence[int]]
    lower: FloatArray
    upper: FloatArray
    period: FloatArray
    material: Material
    eta_reconstruction: float
    scale: float
    tolerance: Tolerance
    figures: Mapping[str, Any]
    origin: Origin
    exponential_steps: int | None = None
    exponential_first_step: FirstStep = "paper"
    draft_error: DraftError | None = None
    auto_error: AutoError | None = None


def require_replaceable(folder: Path, names: Iterable[str] = ()) -> None:
    """Refuse a place for a bundle that holds anything but a bundle: writing there would delete it.

    In a bundle whose manifest is missing or damaged, the usual files and those called ``names`` are the bundle's own.

    Raises:
        BundleError: the folder has files that are not of a bundle, or is a file or a link.
    """
    for parent in folder.parents:
        if parent.exists() and not parent.is_dir():
            raise BundleError(f"{parent} is a file, and bundles lie in a folder: choose another folder for them")
    if not os.path.lexists(folder):
        return
    remedy = "nothing was replaced: move it away, or choose another folder, name or version for the bundle"
    if folder.is_symlink() or not folder.is_dir():
        raise BundleError(f"{folder} is not a folder, so {remedy}")
    present = {path.name for path in folder.iterdir()}
    try:
        own = {MANIFEST, *json.loads((folder / MANIFEST).read_bytes())["files"]} if MANIFEST in present else set()
    except (OSError, ValueError, LookupError, TypeError):
        own = set()
    if {COMBINER.file, GEOMETRY.file, factor_network(0).file} <= present:
        own |= {MANIFEST, CARD, COMBINER.file, GEOMETRY.file, START.file, DECODER, *names}
        own |= {factor_network(j).file for j in range(len(present))}
    if others := sorted(present - own):
        named = ", ".join(map(clipped, others[:3])) + (", …" if len(others) > 3 else "")
        raise BundleError(f"{folder} holds {named}, which no export has written, so {remedy}")


def write_bundle(models: Path, facts: Facts, networks: Networks, geometry: Geometry) -> Path:
    """Write or replace the bundle ``models/NAME/VERSION/``, and return its folder.

    Equal contents give equal bytes.

    Raises:
        BundleError: the folder holds something else, see `require_replaceable`. Nothing is written.
        pydantic.ValidationError: the facts contradict each other or the files. Nothing is written.
        OSError: the folder can't be written.
    """
    files = {factor_network(j).file: content for j, content in enumerate(networks.factors)}
    files |= {COMBINER.file: networks.combiner, GEOMETRY.file: npz_bytes(geometry.arrays(), compressed=False)}
    if networks.start is not None:
        files[START.file] = networks.start
    if geometry.surface:
        files |= geometry.surface.textures
    manifest = _manifest(facts, geometry, files)
    if networks.decoder:
        manifest = _with_decoder(manifest, files, networks.decoder)
    folder = models / facts.name / facts.version
    require_replaceable(folder, files)
    _replace(folder, files, manifest, geometry)
    return folder


def amend_bundle(folder: Path, decoder: ExportedDecoder | None = None, **members: Any) -> None:
    """Replace members of the manifest of a bundle, such as ``auto_error``, and write its card, which it may not have.

    A ``decoder`` replaces ``decoder.onnx``, or the reason why there is none. All networks stay.

    Raises:
        BundleError: there is no valid bundle. Nothing is written.
        pydantic.ValidationError: a member is invalid. Nothing is written.
        OSError: the folder can't be written.
    """
    bundle = read_bundle(folder)
    files = read_files(folder, bundle.manifest)
    manifest = Manifest.model_validate(bundle.manifest.model_dump(by_alias=True) | members)
    if decoder:
        if manifest.decoder:
            files.pop(manifest.decoder.file)
        manifest = _with_decoder(manifest, files, decoder)
    _replace(folder, files, manifest, bundle)


def _with_decoder(manifest: Manifest, files: dict[str, bytes], decoder: ExportedDecoder) -> Manifest:
    if decoder.content is not None:
        files[DECODER] = decoder.content
    listed = {name: entry(files[name]) for name in sorted(files)}
    changes = {"decoder": decoder.entry, "without_decoder": decoder.absent, "files": listed}
    return Manifest.model_validate(dict(manifest) | changes, by_name=True)


def _replace(folder: Path, files: Mapping[str, bytes], manifest: Manifest, geometry: Geometry) -> None:
    """Write or replace a bundle, with its card."""
    files = {**files, CARD: card(manifest, geometry)}
    entries = {name: entry(files[name]) for name in sorted(files)}
    listed = manifest.model_copy(update={"files": entries})
    text = json.dumps(listed.model_dump(by_alias=True), indent=2, ensure_ascii=False) + "\n"
    with replaced_folder(folder) as part:
        for name, content in {**files, MANIFEST: text.encode()}.items():
            with synced_file(part / name) as file:
                file.write(content)


def entry(content: bytes) -> FileEntry:
    """Return the entry of a file in a manifest."""
    return FileEntry(sha256=hashlib.sha256(content).hexdigest(), bytes=len(content))


def _manifest(facts: Facts, geometry: Geometry, files: Mapping[str, bytes]) -> Manifest:
    reference = geometry.reference
    same = ["name", "version", "licence", "title", "description", "eta_reconstruction", "scale"]
    same += ["exponential_steps", "exponential_first_step"]
    return Manifest.model_validate({
        "schema_version": SCHEMA_VERSION,
        **{name: getattr(facts, name) for name in (*same, "draft_error", "auto_error", "origin")},
        "latent_dimension": len(facts.lower),
        "latent_names": list(facts.latent_names),
        "factors": [
            {"name": name, "start": index[0], "stop": index[-1] + 1, **factor_network(j).model_dump()}
            for j, (name, index) in enumerate(facts.factors.items())
        ],
        "lower": facts.lower.tolist(),
        "upper": facts.upper.tolist(),
        "period": [None if np.isnan(period) else period for period in facts.period.tolist()],
        "edges": len(reference.edges),
        "vertices": len(reference.vertices),
        "faces": len(reference.faces),
        "mu": facts.material.mu,
        "lambda": facts.material.lambda_,
        "eta": facts.material.eta,
        "combiner": COMBINER,
        "start": START if START.file in files else None,
        "geometry": GEOMETRY,
        "surface": surface_entry(geometry.surface) if geometry.surface else None,
        "onnx_tolerance": facts.tolerance,
        "figures": dict(facts.figures),
        "files": {name: entry(files[name]) for name in sorted(files)},
    })  # fmt: skip
