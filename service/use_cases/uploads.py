"""Mesh files in requests: a request's body, or one part of a form.

This module imports neither the server nor models, so that a sandbox process can import it fast. That process limits the
time and memory of reading, see `shapespace.service.limits.sandbox`.
"""

from __future__ import annotations

import json
import zipfile
from array import array
from collections.abc import Collection, Iterable
from itertools import chain
from typing import NamedTuple

import numpy as np
from python_multipart.multipart import parse_options_header

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.archives import Place, natural_order, seekable
from shapespace.files.limits import Limits, clipped, label, reason
from shapespace.files.reading import OCTET_STREAM, READ_FORMATS, SCAN_FORMATS, read_arrays
from shapespace.files.recognition import Assumed, FormatError, decide
from shapespace.mesh.triangle_mesh import MeshError
from shapespace.service.limits.sandbox_messages import Arrays, JsonObject
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.forms import (
    LONGEST_HEADER,
    read_form,
)
from shapespace.service.use_cases.json_names import repeated_member

#: Media types of the formats that can be read, by name.
FORMATS = READ_FORMATS | {"json": "application/json"}
#: Media types of the formats of scans, which may be points without faces.
POINT_FORMATS = SCAN_FORMATS | {"json": "application/json"}
#: An archive of files of these formats.
ARCHIVE = "zip"
#: Formats by media type, with further names of media types.
MEDIA_TYPES = {
    "application/zip": ARCHIVE,
    "application/x-zip-compressed": ARCHIVE,
    "model/x.stl-ascii": "stl",
    "model/x.stl-binary": "stl",
    "application/sla": "stl",
    "application/ply": "ply",
    "application/x-npz": "npz",
} | {media_type: name for name, media_type in POINT_FORMATS.items() if media_type not in (OCTET_STREAM, "text/plain")}
#: What the format follows from where a client says it.
_GIVEN = "?format="
#: Most vertices, and most faces, of all meshes of an archive.
TOGETHER = Limits(2**21, 2**21)


#: Kinds of problems of uploads, which a sandbox process names.
UPLOAD_KINDS = ("invalid-mesh", "malformed-request", "invalid-request", "unsupported-media-type")


class UploadedMesh(NamedTuple):
    """A mesh as it is in its file: vertices (V, 3), faces (F, 3) or none, and the file's name in an archive."""

    vertices: FloatArray
    faces: IntArray
    name: str = ""


def read_mesh_files(
    body: bytes | bytearray,
    content_type: str,
    format: str | None,
    limits: Limits,
    *,
    points: bool = False,
    known: Collection[str] | None = None,
    most: int = 1,
) -> tuple[list[UploadedMesh], dict[str, str]]:
    """Read the mesh in the body of a request, or the meshes of an archive in the order of their names.

    The format is ``format``, or else follows from the file's first bytes, its name, or the content type.

    Args:
        body: a mesh file, an archive of mesh files, or a ``multipart/form-data`` form with such a file.
        content_type: the header; empty if there is none.
        format: value of ``?format=``, if any. A field ``format`` of a form has priority.
        limits: largest numbers of vertices and faces of a mesh.
        points: whether points without faces are accepted.
        known: names of the fields that the form may have; None accepts all.
        most: largest number of meshes.

    Returns:
        The meshes, and the fields of the form.

    Raises:
        RefusedError: there is no file, the form or the file can't be read, or the format is unknown.
    """
    name, fields, formats = "", dict[str, str](), POINT_FORMATS if points else FORMATS
    declared, options = parse_options_header(content_type[:LONGEST_HEADER])
    data, media_type = memoryview(body), declared.decode("latin-1")
    if declared == b"multipart/form-data":
        file, fields = read_form(body, options.get(b"boundary"), known)
        if file is None:
            raise RefusedError(
                "invalid-mesh",
                "The form has no file. Send the mesh file as a field with a file name: -F file=@mesh.obj",
            )
        data, name, media_type = file.data, file.file_name or "", file.media_type
    if not data:
        raise RefusedError("invalid-mesh", "The file is empty. Send a mesh file as the body, or as a file in a form.")
    accepted = ", ".join((*formats, ARCHIVE))
    try:
        found = _format(data, (*formats, ARCHIVE), fields.get("format") or format, name, media_type)
    except FormatError as error:
        sentence = (
            f"The file {str(error).rstrip('.')}. Send one of {accepted}. If it is one of these, name it with ?format=."
        )
        raise RefusedError("unsupported-media-type", sentence) from None
    try:
        if found.name == ARCHIVE:
            return _read_archive(data, limits, points=points, most=most), fields
        return [_read(data, found.name, limits, points=points)], fields
    except MeshError as error:
        fault = str(error).rstrip(".") + (_looks_otherwise(data, found) if found.because == _GIVEN else "")
        raise RefusedError(
            "invalid-mesh",
            f"The mesh can't be used: {fault}. The server read it as {found.name}, as {found.because} says. "
            f"Send a correct {found.name} file. If it has another format, name it with ?format=: {accepted}.",
        ) from None


def _format(data: memoryview, formats: Collection[str], given: str | None, name: str, media_type: str) -> Assumed:
    if not given:
        return decide(data, formats, name, media_type, MEDIA_TYPES)
    if given.lower() not in formats:
        raise FormatError(f"can't be read: there is no format {clipped(given)!r} here")
    return Assumed(given.lower(), _GIVEN)


def _looks_otherwise(data: memoryview, assumed: Assumed) -> str:
    """Return the end of a sentence about a file that is not what a client says."""
    try:
        found = decide(data, (*POINT_FORMATS, ARCHIVE))
    except FormatError as error:
        return f"; it {error}" if str(error).startswith("is ") else ""
    return f"; it looks like {found.name}" if found.name != assumed.name else ""


def _read(
    data: memoryview, format: str, limits: Limits, *, points: bool, name: str = "", beside: Place | None = None
) -> UploadedMesh:
    if format == "json":
        return UploadedMesh(*_checked(*_read_json(data, limits)), name)
    return UploadedMesh(*_checked(*read_arrays(data, format, limits, points=points, beside=beside)), name)


def _read_archive(data: memoryview, limits: Limits, *, points: bool, most: int) -> list[UploadedMesh]:
    """Read the meshes of an archive in the natural order of their names; other files are left out."""
    try:
        with zipfile.ZipFile(seekable(data)) as archive:
            there = [e for e in archive.infolist() if not e.is_dir() and not _hidden(e.filename)]
            # A folder of meshes may have a README.txt.
            for formats in (READ_FORMATS, SCAN_FORMATS) if points else (READ_FORMATS,):
                if entries := [e for e in there if _extension(e.filename) in formats]:
                    break
            if not entries:
                names = clipped(", ".join(label(e.filename) or "" for e in there))
                raise MeshError(f"the archive holds no mesh file, only {names}" if names else "the archive is empty")
            if len(entries) > most:
                many = f"more than {most} meshes" if most > 1 else f"{len(entries)} meshes, where one is needed"
                raise MeshError(f"the archive holds {many}: send fewer at once")
            meshes: list[UploadedMesh] = []
            for entry in sorted(entries, key=lambda e: (natural_order(e.filename), e.filename)):
                meshes.append(_read_member(archive, entry, limits, points=points))
                if np.array_equal(meshes[-1].faces, meshes[0].faces):
                    meshes[-1] = meshes[-1]._replace(faces=meshes[0].faces)  # so that they take memory once
                TOGETHER.check(sum(len(m.vertices) for m in meshes), sum(len(m.faces) for m in meshes))
            return meshes
    except (MeshError, MemoryError):
        raise
    except Exception as error:  # damaged files raise exceptions of many classes
        raise MeshError("the archive is damaged, or protected by a password") from error


def _read_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, limits: Limits, *, points: bool) -> UploadedMesh:
    content, name = archive.read(entry), label(entry.filename) or ""
    try:
        format = decide(memoryview(content), SCAN_FORMATS if points else READ_FORMATS, entry.filename).name
        beside = zipfile.Path(archive, entry.filename)
        return _read(memoryview(content), format, limits, points=points, name=name, beside=beside)
    except MeshError as error:
        raise MeshError(f"{name}: {error}") from None


def _hidden(name: str) -> bool:
    """Whether a member of an archive is hidden. macOS adds such members."""
    return any(part.startswith((".", "__MACOSX")) for part in name.split("/") if part not in (".", ".."))


def _extension(name: str) -> str:
    return name.rpartition(".")[2].lower()


def read_in_sandbox(
    body: bytearray,
    content_type: str,
    format: str | None,
    vertices: int,
    faces: int,
    points: bool,
    known: list[str],
    most: int,
) -> tuple[JsonObject, Arrays]:
    """Run `read_mesh_files` as a task of a sandbox. Equal faces are sent once."""
    limits = Limits(vertices, faces)
    meshes, fields = read_mesh_files(body, content_type, format, limits, points=points, known=known, most=most)
    arrays: Arrays = {f"vertices {k}": mesh.vertices for k, mesh in enumerate(meshes)}
    arrays |= {f"faces {k}": m.faces for k, m in enumerate(meshes) if not k or m.faces is not meshes[0].faces}
    return {"fields": fields, "names": [mesh.name for mesh in meshes]}, arrays


def _read_json(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    text = bytes(data)
    try:
        # orjson would crash at the end of its memory, where this module raises MemoryError.
        content = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise MeshError(f"not JSON: {reason(error)}") from None
    if name := repeated_member(text):
        raise MeshError(f"it has the member {name!r} twice")
    if not isinstance(content, dict) or "vertices" not in content:
        raise MeshError('not an object {"vertices": [[x, y, z], …], "faces": [[a, b, c], …]}')
    vertices = _triples("d", content["vertices"], "vertices must be lists of three numbers each")
    faces = _triples("q", content.get("faces") or [], "faces must be lists of three whole numbers each")
    limits.check(len(vertices), len(faces))
    return vertices, faces


def _triples(kind: str, rows: object, otherwise: str) -> np.ndarray:
    """Return rows of three numbers as an array; raises MeshError(otherwise) for anything else."""
    numbers = array(kind)
    try:
        if not isinstance(rows, list) or any(len(row) != 3 for row in rows):
            raise MeshError(otherwise)
        flat: Iterable = chain.from_iterable(rows)
        numbers.extend(flat)
    except (TypeError, OverflowError):
        raise MeshError(otherwise) from None
    return np.array(numbers).reshape(-1, 3)


def _checked(vertices: np.ndarray, faces: np.ndarray) -> tuple[FloatArray, IntArray]:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu" or not len(vertices):
        raise MeshError(f"vertices must be (V, 3) numbers, not {clipped(vertices.dtype)} of shape {vertices.shape}")
    if faces.size and (faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu"):
        raise MeshError(f"faces must be (F, 3) whole numbers, not {clipped(faces.dtype)} of shape {faces.shape}")
    with np.errstate(all="ignore"):  # a long double may be too large for a double
        return vertices.astype(np.float64, copy=False), faces.reshape(-1, 3).astype(np.int64, copy=False)
