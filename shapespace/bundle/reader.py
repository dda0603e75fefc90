"""Reader of bundles. It checks every byte against the manifest before it parses a file."""

import hashlib
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from pydantic import ValidationError

from shapespace.bundle.geometry import Geometry, GeometryError
from shapespace.bundle.schema import MANIFEST, NAME_PATTERN, VERSION_PATTERN, DecoderEntry, FileEntry, Manifest
from shapespace.files.npz import npz_headers, read_npz

#: Most bytes of a manifest.
MANIFEST_LIMIT = 4 * 2**20
#: Most bytes of all files of a bundle.
LARGEST = 2**30
#: Largest size of the arrays of an NPZ file: this multiple of the size of the file, plus a constant in bytes.
#: Compression makes meshes two to six times smaller; data that become much smaller are not a mesh.
UNPACKED, BESIDE = 16, 2**20
#: Most characters of a message. Libraries quote what they can't read, and names in a file can have any length.
LONGEST_REASON = 300


class BundleError(ValueError):
    """A bundle can't be used; the message is one line."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]} …")


@dataclass(frozen=True, kw_only=True)
class Bundle(Geometry):
    """Content of a bundle, verified against its manifest."""

    manifest: Manifest
    # SHA-256 of the manifest in hexadecimal. The manifest has the digests of all files, so this digest identifies every
    # byte of the bundle.
    digest: str
    networks: Mapping[str, bytes]  # content of each ONNX file by name
    folder: Path  # where it was read


def check_place(folder: Path) -> None:
    """Raise BundleError unless a folder is called NAME/VERSION."""
    if not re.fullmatch(NAME_PATTERN, folder.parent.name) or not re.fullmatch(VERSION_PATTERN, folder.name):
        raise BundleError(
            "a bundle must be in a folder NAME/VERSION, with a name in small letters and a whole number as version"
        )


def manifest_digest(folder: Path) -> str:
    """Return the digest of the bundle that is in a folder now; raises BundleError or OSError."""
    return hashlib.sha256(_manifest(folder)).hexdigest()


def read_bundle(folder: Path, digest: str | None = None) -> Bundle:
    """Read and verify ``models/NAME/VERSION``, which must have the digest if one is given. Raises BundleError if the
    bundle differs from its manifest, or breaks the schema.
    """
    check_place(folder)
    name, version = folder.parent.name, folder.name
    text = _manifest(folder)
    if digest not in (None, hashlib.sha256(text).hexdigest()):
        raise BundleError("its files changed while the server tested it")
    try:
        manifest = Manifest.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise BundleError(f"{MANIFEST}: {place + ': ' if place else ''}{first['msg']}") from None
    if (manifest.name, manifest.version) != (name, version):
        raise BundleError(f"{MANIFEST} is of {manifest.name}/{manifest.version}, not of {name}/{version}")
    files = read_files(folder, manifest)
    textures = {file: files.pop(file) for file in (manifest.surface.textures if manifest.surface else ())}
    geometry = _geometry(files.pop(manifest.geometry.file), manifest, textures)
    for file, content in files.items():
        network = _network(file, content)
        if manifest.decoder and file == manifest.decoder.file:
            finest = geometry.fine.reference if geometry.fine else geometry.reference
            _check_decoder(network, manifest.decoder, manifest.latent_dimension, len(finest.vertices))
        _check_weights(file, network)
    return Bundle(
        manifest=manifest,
        digest=hashlib.sha256(text).hexdigest(),
        networks=files,
        folder=folder,
        **vars(geometry),
    )


def read_files(folder: Path, manifest: Manifest) -> dict[str, bytes]:
    """Return the files of a bundle, verified against its manifest; raises BundleError or OSError."""
    present = _regular_files(folder)
    for missing in sorted(manifest.files.keys() - present):
        raise BundleError(f"{missing} is missing")
    for extra in sorted(present - manifest.files.keys() - {MANIFEST}):
        raise BundleError(f"{extra} is not in the manifest")
    if sum((folder / file).lstat().st_size for file in present) > LARGEST:
        raise BundleError(f"its files have more than {LARGEST >> 20} MiB")
    return {file: _verified(folder / file, entry) for file, entry in manifest.files.items()}


def _manifest(folder: Path) -> bytes:
    if MANIFEST not in _regular_files(folder):
        raise BundleError(f"{MANIFEST} is missing")
    return _read(folder / MANIFEST, MANIFEST_LIMIT)


def _regular_files(folder: Path) -> set[str]:
    for path in (folder.parent, folder):
        if path.is_symlink():
            raise BundleError(f"{path.name} is a link; bundles must be real folders")
    with os.scandir(folder) as entries:
        found = list(entries)
    for entry in sorted(found, key=lambda entry: entry.name):
        if not entry.is_file(follow_symlinks=False):
            raise BundleError(f"{entry.name} is a link or not a plain file")
    return {entry.name for entry in found}


def _read(path: Path, limit: int) -> bytes:
    # The file could have become a link or a pipe since the folder was listed. The flags refuse both.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_size > limit:
            raise BundleError(f"{path.name} has more than {limit} bytes")
        return file.read(status.st_size + 1)  # not the limit, because a manifest can declare a terabyte


def _verified(path: Path, entry: FileEntry) -> bytes:
    content = _read(path, min(entry.bytes, LARGEST))
    if len(content) != entry.bytes:
        raise BundleError(f"{path.name} has {len(content)} bytes, not {entry.bytes} as the manifest says")
    if hashlib.sha256(content).hexdigest() != entry.sha256:
        raise BundleError(f"{path.name} does not have the digest that the manifest says")
    return content


def _geometry(content: bytes, manifest: Manifest, textures: Mapping[str, bytes]) -> Geometry:
    file = manifest.geometry.file
    try:
        total, most = sum(header.nbytes for header in npz_headers(content).values()), UNPACKED * len(content) + BESIDE
        if total > most:
            raise BundleError(f"{file}: its arrays would have {total} bytes, but at most {most} are allowed")
        arrays = read_npz(content)
    except BundleError:
        raise
    except Exception as error:  # damaged files raise exceptions of many classes
        raise BundleError(f"{file} is not a readable NPZ file: {error}") from None
    try:
        return Geometry.from_arrays(arrays, manifest, textures)
    except GeometryError as error:
        raise BundleError(str(error)) from None


def _network(file: str, content: bytes) -> onnx.ModelProto:
    try:
        return onnx.load_model_from_string(content)
    except Exception as error:  # protobuf's errors have no common public class
        raise BundleError(f"{file} is not a readable ONNX file: {error}") from None


def _check_decoder(model: onnx.ModelProto, decoder: DecoderEntry, latents: int, vertices: int) -> None:
    """Check the names of the decoder's input and outputs, then their axes."""
    initialised = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in initialised]
    for role, values, rows in (
        ("inputs", inputs, {decoder.input: [latents]}),
        ("outputs", model.graph.output, {decoder.vertices: [vertices, 3], decoder.misfit: []}),
    ):
        found = [value.name for value in values]
        if found != list(rows):
            raise BundleError(f"{decoder.file} must have the {role} {', '.join(rows)}, not {', '.join(found)}")
        for value, row in zip(values, rows.values(), strict=True):
            kind, sizes = value.type.tensor_type, value.type.tensor_type.shape.dim
            fixed = [size.dim_value for size in sizes]
            if kind.elem_type != onnx.TensorProto.FLOAT or len(sizes) != 1 + len(row) or fixed != [0, *row]:
                raise BundleError(f"{decoder.file}: {value.name} must be float32 {['n', *row]}")


def _check_weights(file: str, model: onnx.ModelProto) -> None:
    functions = (node for function in model.functions for node in function.node)
    for tensor in [*_tensors_of_graph(model.graph), *_tensors_of_nodes(functions)]:
        name = tensor.name or "a tensor"
        if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
            raise BundleError(f"{file}: {name} has its data in another file")
        try:
            values = onnx.numpy_helper.to_array(tensor)
        except Exception as error:  # an unknown type, or too few data
            raise BundleError(f"{file}: {name} can't be read: {error}") from None
        if not _is_finite(values):
            raise BundleError(f"{file}: {name} has a weight that is not finite")


def _tensors_of_graph(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    yield from graph.initializer
    for sparse in graph.sparse_initializer:
        yield from (sparse.values, sparse.indices)
    yield from _tensors_of_nodes(graph.node)


def _tensors_of_nodes(nodes: Iterable[onnx.NodeProto]) -> Iterator[onnx.TensorProto]:
    for node in nodes:
        for attribute in node.attribute:
            yield from (*([attribute.t] if attribute.HasField("t") else []), *attribute.tensors)
            for sparse in [*([attribute.sparse_tensor] if attribute.HasField("sparse_tensor") else [])]:
                yield from (sparse.values, sparse.indices)
            for graph in (*([attribute.g] if attribute.HasField("g") else []), *attribute.graphs):
                yield from _tensors_of_graph(graph)


def _is_finite(array: NDArray) -> bool:
    return array.dtype.kind not in "fc" or bool(np.isfinite(array).all())
