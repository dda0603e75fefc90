"""Reading one bundle: every byte checked against the manifest before anything is parsed."""

from __future__ import annotations

import hashlib
import io
import math
import os
import re
import stat
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from pydantic import ValidationError

from shapespace.arrays import FloatArray, IntArray
from shapespace.bundle.schema import NAME_PATTERN, VERSION_PATTERN, FileEntry, Manifest
from shapespace.mesh.prolongation import PREFIX, Prolongation, ProlongationError
from shapespace.mesh.triangle_mesh import MeshError, TriangleMesh

MANIFEST = "manifest.json"
MANIFEST_LIMIT = 4 * 2**20
#: The fine mesh lies this close to what the reference is prolonged to, as a fraction of the diagonal: float32.
FINE_TOLERANCE = 1e-5
#: Bytes of a bundle's files together.
LARGEST = 2**30
#: What the arrays of an NPZ file may come to: so many times its own length, and so many bytes beside. Packed meshes are
#: a half to a sixth as long; what packs much better is no mesh.
UNPACKED, BESIDE = 16, 2**20
#: Characters of a reason: libraries quote what they can't read, and names in a file are as long as it says.
LONGEST_REASON = 300


class BundleError(ValueError):
    """A bundle that must not be served, with one line that says why."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]} …")


@dataclass(frozen=True)
class FineMesh:
    """A finer mesh that follows the coarse one.

    Attributes:
        reference: at the coarse reference.
        prolong: coarse vertices to fine ones.
    """

    reference: TriangleMesh
    prolong: Prolongation


@dataclass(frozen=True)
class Bundle:
    """A bundle whose files are what the manifest says, read into memory.

    Attributes:
        manifest: what it says about itself.
        digest: SHA-256 of the manifest in hexadecimal. The manifest holds the digests of all files, so this
            one identifies every byte of the bundle.
        reference: the reference shape, normalised.
        fine: the finer mesh, if there is one.
        networks: bytes of each ONNX file by its name.
        modes: (m, V, 3) vertex fields d_j at the reference, where codes are coefficients of tangent vectors.
        training_codes: (n, m) codes of the shapes that the model was made from, if there are any.
        file_vertices: (N,) vertex of the finest mesh that each vertex of the user's files became, −1 for those in no
            face; None where that is each by itself.
    """

    manifest: Manifest
    digest: str
    reference: TriangleMesh
    fine: FineMesh | None
    networks: Mapping[str, bytes]
    modes: FloatArray | None = None
    training_codes: FloatArray | None = None
    file_vertices: IntArray | None = None


def check_place(folder: Path) -> None:
    """Refuse folders that aren't called NAME/VERSION; raises BundleError."""
    if not re.fullmatch(NAME_PATTERN, folder.parent.name) or not re.fullmatch(VERSION_PATTERN, folder.name):
        raise BundleError("a bundle lies in NAME/VERSION: a name in small letters, a version that is a whole number")


def manifest_digest(folder: Path) -> str:
    """The digest of the bundle that lies there at the moment; raises BundleError or OSError."""
    return hashlib.sha256(_manifest(folder)).hexdigest()


def read_bundle(folder: Path, digest: str | None = None) -> Bundle:
    """Read and verify ``models/NAME/VERSION``.

    Args:
        folder: of the bundle.
        digest: that it must have; by default any.

    Raises:
        BundleError: anything that isn't exactly as the manifest and the contract say.
    """
    check_place(folder)
    name, version = folder.parent.name, folder.name
    text = _manifest(folder)
    if digest not in (None, hashlib.sha256(text).hexdigest()):
        raise BundleError("it changed while it was tried")
    try:
        manifest = Manifest.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise BundleError(f"{MANIFEST}: {place + ': ' if place else ''}{first['msg']}") from None
    if (manifest.name, manifest.version) != (name, version):
        raise BundleError(f"{MANIFEST} is of {manifest.name}/{manifest.version}, not of {name}/{version}")
    files = read_files(folder, manifest)
    reference, fine, more = _geometry(files.pop(manifest.geometry.file), manifest)
    for file, content in files.items():
        _check_network(file, content)
    return Bundle(manifest, hashlib.sha256(text).hexdigest(), reference, fine, files, **more)


def read_files(folder: Path, manifest: Manifest) -> dict[str, bytes]:
    """The files of a bundle, which are what its manifest says; raises BundleError or OSError."""
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
    # The flags close the gap between looking at the folder and opening the file: no link, no waiting for a pipe.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_size > limit:
            raise BundleError(f"{path.name} is longer than {limit} bytes")
        return file.read(status.st_size + 1)  # not the limit: a manifest may promise a terabyte


def _verified(path: Path, entry: FileEntry) -> bytes:
    content = _read(path, min(entry.bytes, LARGEST))
    if len(content) != entry.bytes:
        raise BundleError(f"{path.name} has {len(content)} bytes, not {entry.bytes} as the manifest says")
    if hashlib.sha256(content).hexdigest() != entry.sha256:
        raise BundleError(f"{path.name} does not have the digest that the manifest says")
    return content


def _geometry(content: bytes, manifest: Manifest) -> tuple[TriangleMesh, FineMesh | None, dict[str, NDArray]]:
    file = manifest.geometry.file
    try:
        geometry = _arrays(content)
        reference = TriangleMesh.from_mapping(geometry)
        edges = geometry["edges"]
    except KeyError as error:
        raise BundleError(f"{file} has no array {error}") from None
    except (BundleError, MeshError) as error:
        raise BundleError(f"{file}: {error}") from None
    except Exception as error:  # zip and array headers fail in many ways
        raise BundleError(f"{file} is not a readable NPZ file: {error}") from None
    for array_name, array in geometry.items():
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise BundleError(f"{file}: {array_name} has an entry that is not finite")
    counts = (len(reference.vertices), len(reference.faces), len(reference.edges))
    if counts != (manifest.vertices, manifest.faces, manifest.edges):
        raise BundleError(
            f"{file} has (V, F, E) = {counts}, the manifest says {(manifest.vertices, manifest.faces, manifest.edges)}"
        )
    if not np.array_equal(edges, reference.edges):
        raise BundleError(f"{file}: edges are not those of the faces in lexicographic order")
    m, V = manifest.latent_dimension, manifest.vertices
    for array_name, wanted, text in (
        ("modes", (m, V, 3), f"({m}, {V}, 3)"),
        ("training_codes", (None, m), f"(n, {m})"),
    ):
        _check_shape(file, geometry, array_name, wanted, text)
    fine = _fine(file, geometry, reference)
    more: dict[str, NDArray] = {
        name: geometry[name].astype(np.float64) for name in ("modes", "training_codes") if name in geometry
    }
    if "file_vertices" in geometry:
        more["file_vertices"] = _file_vertices(file, geometry["file_vertices"], fine.reference if fine else reference)
    return reference, fine, more


def _arrays(content: bytes) -> dict[str, NDArray]:
    """The arrays of an NPZ file; none is made before it is known how long it is, and that it is so long."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = archive.infolist()
        most = UNPACKED * len(content) + BESIDE
        if (total := sum(entry.file_size for entry in entries)) > most:
            raise BundleError(f"its arrays would come to {total} bytes, where {most} are the most")
        return {entry.filename.removesuffix(".npy"): _array(archive, entry) for entry in entries}


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray:
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others unpack all at once
        raise ValueError(f"{entry.filename} is packed in a way that NumPy doesn't")
    with archive.open(entry) as file:
        match np.lib.format.read_magic(file):
            case (1, 0):
                shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
            case (2, 0):
                shape, fortran, dtype = np.lib.format.read_array_header_2_0(file)
            case version:
                raise ValueError(f"{entry.filename} is of version {version}")
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or not 0 <= size <= entry.file_size:
            raise ValueError(f"{entry.filename} can't be {dtype} {shape}")
        array = np.frombuffer(bytearray(file.read(size)), dtype)
        return array.reshape(shape, order="F" if fortran else "C")


def _file_vertices(file: str, places: NDArray, mesh: TriangleMesh) -> IntArray:
    """Checked: whole numbers (N,) that name every vertex of the finest mesh."""
    count = len(mesh.vertices)
    if places.ndim != 1 or not np.issubdtype(places.dtype, np.integer) or len(places) < count:
        raise BundleError(
            f"{file}: file_vertices must be at least {count} whole numbers, not {places.dtype} {places.shape}"
        )
    if not np.array_equal(np.unique(places[places != -1]), np.arange(count)):
        raise BundleError(f"{file}: file_vertices must name each of the vertices 0 to {count - 1}, or -1")
    return places.astype(np.int64)


def _check_shape(
    file: str, geometry: Mapping[str, NDArray], name: str, wanted: tuple[int | None, ...], text: str
) -> None:
    if name not in geometry:
        return
    array = geometry[name]
    if not array.size:
        raise BundleError(f"{file}: {name} is empty")
    fits = len(array.shape) == len(wanted) and all(
        want in (None, size) for size, want in zip(array.shape, wanted, strict=True)
    )
    if not fits or not np.issubdtype(array.dtype, np.floating):
        raise BundleError(f"{file}: {name} must be real numbers {text}, not {array.dtype} {array.shape}")


def _fine(file: str, geometry: Mapping[str, NDArray], reference: TriangleMesh) -> FineMesh | None:
    if not any(name.startswith(("fine_", PREFIX)) for name in geometry):
        return None
    try:
        fine = TriangleMesh.from_arrays(geometry["fine_vertices"], geometry["fine_faces"])
        prolong = Prolongation.from_arrays(geometry)
    except KeyError as error:
        raise BundleError(f"{file} has no array {error}, which goes with the other arrays of a fine mesh") from None
    except ProlongationError as error:
        raise BundleError(f"{file}: {error}") from None
    except MeshError as error:
        raise BundleError(f"{file}: fine mesh: {error}") from None
    if not np.array_equal(prolong.faces, reference.faces):
        raise BundleError(f"{file}: {PREFIX}faces are not the faces of the mesh")
    if prolong.vertex_count != len(fine.vertices):
        raise BundleError(
            f"{file}: the prolongation is to {prolong.vertex_count} vertices, but there are {len(fine.vertices)} "
            "fine_vertices"
        )
    distance = np.linalg.norm(prolong(reference.vertices) - fine.vertices, axis=1).max()
    if distance > FINE_TOLERANCE * fine.diagonal:
        raise BundleError(
            f"{file}: fine_vertices are up to {distance:.1e} away from where the prolongation takes the reference"
        )
    return FineMesh(fine, prolong)


def _check_network(file: str, content: bytes) -> None:
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # protobuf's errors have no common public class
        raise BundleError(f"{file} is not a readable ONNX file: {error}") from None
    functions = (node for function in model.functions for node in function.node)
    for tensor in [*_tensors_of_graph(model.graph), *_tensors_of_nodes(functions)]:
        name = tensor.name or "a tensor"
        if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
            raise BundleError(f"{file}: {name} keeps its data in another file")
        try:
            values = onnx.numpy_helper.to_array(tensor)
        except Exception as error:  # of an unknown type, or too little for its shape
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
