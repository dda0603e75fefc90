"""Mesh files in requests: a request's body, or one part of a form.

This module imports neither the server nor models, so that a sandbox process can import it fast. That process limits the
time and memory of reading, see `shapespace.service.limits.sandbox`.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Collection, Iterable
from itertools import chain
from pathlib import PurePath

import numpy as np
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, clipped
from shapespace.files.reading import OCTET_STREAM, READ_FORMATS, SCAN_FORMATS, read_arrays
from shapespace.mesh.triangle_mesh import MeshError
from shapespace.service.limits.sandbox_errors import FailedError
from shapespace.service.limits.sandbox_wire import Arrays, JsonObject

#: Media types of the formats that can be read, by name.
FORMATS = READ_FORMATS | {"json": "application/json"}
#: Media types of the formats of scans, which may be points without faces.
POINT_FORMATS = SCAN_FORMATS | {"json": "application/json"}
#: Formats by media type, with further names of media types.
MEDIA_TYPES = {
    "text/plain": "obj",
    "model/x.stl-ascii": "stl",
    "model/x.stl-binary": "stl",
    "application/sla": "stl",
    "application/ply": "ply",
    "application/x-npz": "npz",
} | {media_type: name for name, media_type in FORMATS.items() if media_type != OCTET_STREAM}
_MAGIC = {b"glTF": "glb", b"ply": "ply", b"PK": "npz", b"OFF": "off"}
#: Most characters of a Content-Type or Content-Disposition header.
_LONGEST_HEADER = 1000
#: Most fields of a form besides the file.
_MOST_FIELDS = 16
#: Most bytes of the field ``options``.
_LONGEST_OPTIONS = 2**18


class UploadError(ValueError):
    """An upload that can't be used. The message says what is wrong and what to do."""


class UnusableMeshError(UploadError):
    """There is no file, or it holds no mesh within the limits."""


class UnreadableFormError(UploadError):
    """The form breaks the rules of its format, or holds more than one file."""


class UnknownFormatError(UploadError):
    """The request names no format, or an unknown one."""


#: Classes of errors by name. A sandbox process sends the name.
UPLOAD_ERRORS = {error.__name__: error for error in (UnusableMeshError, UnreadableFormError, UnknownFormatError)}


def read_mesh_file(
    body: bytes | bytearray, content_type: str, format: str | None, limits: Limits, *, points: bool = False
) -> tuple[FloatArray, IntArray, str]:
    """Read the mesh in the body of a request.

    The format is ``format``, or else follows from the content type, the name of the file, or its first bytes.

    Args:
        body: a mesh file, or a ``multipart/form-data`` form with a mesh file.
        content_type: the header; empty if there is none.
        format: value of ``?format=``, if any.
        limits: largest numbers of vertices and faces.
        points: whether points without faces are accepted.

    Returns:
        Vertices (V, 3) as in the file, faces (F, 3) or none, and the form's field ``options``.

    Raises:
        UploadError: there is no file, the form or the file can't be read, or the format is unknown.
    """
    data, name, said, formats = memoryview(body), "", b"", POINT_FORMATS if points else FORMATS
    declared, options = parse_options_header(content_type[:_LONGEST_HEADER])
    if declared == b"multipart/form-data":
        form = _Form(body, options.get(b"boundary"))
        data, name, declared = form.file()
        said = form.options
    if not data:
        raise UnusableMeshError("The file is empty. Send a mesh file as the body, or as a file of a form.")
    found = format or _guess(declared.decode("latin-1"), name, bytes(data[:4]), formats)
    if found not in formats:
        listed = ", ".join(f"{name} ({media_type})" for name, media_type in formats.items())
        told = clipped(declared.decode("latin-1")) or "No content type"
        fault = f"There is no format {clipped(format)!r} here" if format else f"{told} tells no format"
        raise UnknownFormatError(f"{fault}. Say by ?format= or Content-Type which: {listed}.")
    try:
        if found == "json":
            vertices, faces = _read_json(data, limits)
        else:
            vertices, faces = read_arrays(data, found, limits, points=points)
        return *_checked(vertices, faces), said.decode(errors="replace")
    except MeshError as error:
        sentence = f"The mesh can't be used: {str(error).rstrip('.')}. Send one {found} file."
        raise UnusableMeshError(sentence) from None


def _guess(declared: str, name: str, start: bytes, formats: Collection[str]) -> str | None:
    suffix = PurePath(name).suffix.lstrip(".").lower()
    magic = next((format for magic, format in _MAGIC.items() if start.startswith(magic)), "")
    return next((guess for guess in (MEDIA_TYPES.get(declared), suffix, magic) if guess in formats), None)


def read_in_sandbox(
    body: bytearray, content_type: str, format: str | None, vertices: int, faces: int, points: bool = False
) -> tuple[JsonObject, Arrays]:
    """Run `read_mesh_file` as a task of a sandbox; raises FailedError."""
    try:
        found = read_mesh_file(body, content_type, format, Limits(vertices, faces), points=points)
    except UploadError as error:
        raise FailedError(type(error).__name__, str(error)) from None
    return {"options": found[2]}, {"vertices": found[0], "faces": found[1]}


class _Form:
    """Parser of a ``multipart/form-data`` form with one file, and maybe a field ``options``. It copies no file."""

    def __init__(self, body: bytes | bytearray, boundary: bytes | None) -> None:
        self._body, self._boundary = body, boundary
        self._headers: dict[bytes, bytes] = {}
        self._header, self._name = b"", ""
        self._fields = self._files = 0
        self._is_file, self._start, self._stop = False, 0, 0
        self._found: tuple[memoryview, str, bytes] | None = None
        self._field = b""
        self.options = b""

    def file(self) -> tuple[memoryview, str, bytes]:
        """Return content, name and declared media type of the file; raises UploadError if there is not one."""
        if self._boundary is None:
            raise self._unreadable("Missing boundary in multipart.")
        if self._body.count(b"\r\n--" + self._boundary) > 2 * _MOST_FIELDS:
            raise self._unreadable("Too many parts.")
        try:
            parser = MultipartParser(
                self._boundary,
                {
                    "on_part_begin": self._headers.clear,
                    "on_header_field": self._on_header_field,
                    "on_header_value": self._on_header_value,
                    "on_headers_finished": self._on_headers_finished,
                    "on_part_data": self._on_part_data,
                    "on_part_end": self._on_part_end,
                },
            )
            # In one call, so that positions are positions in the body.
            parser.write(self._body)  # type: ignore[arg-type]
        except FormParserError:
            raise self._unreadable("Invalid multipart data.") from None
        if self._found is None:
            raise UnusableMeshError("The form holds no file. Send the mesh file as one of its fields.")
        return self._found

    def _unreadable(self, why: str) -> UnreadableFormError:
        return UnreadableFormError(f"The form can't be read: {why} Send one file in it.")

    def _on_header_field(self, data: bytes, start: int, stop: int) -> None:
        self._header = bytes(data[start : min(stop, start + _LONGEST_HEADER)]).lower()

    def _on_header_value(self, data: bytes, start: int, stop: int) -> None:
        self._headers[self._header] = bytes(data[start : min(stop, start + _LONGEST_HEADER)])

    def _on_headers_finished(self) -> None:
        _, options = parse_options_header(self._headers.get(b"content-disposition"))
        if b"name" not in options:
            raise self._unreadable('The Content-Disposition header field "name" must be provided.')
        self._is_file, self._start, self._stop = b"filename" in options, 0, 0
        self._files += self._is_file
        self._fields += not self._is_file
        if self._files > 1:
            raise self._unreadable("Too many files. Maximum number of files is 1.")
        if self._fields > _MOST_FIELDS:
            raise self._unreadable(f"Too many fields. Maximum number of fields is {_MOST_FIELDS}.")
        self._name = options.get(b"filename", b"").decode(errors="replace")
        self._field = options[b"name"]

    def _on_part_data(self, data: bytes, start: int, stop: int) -> None:
        self._start, self._stop = self._start or start, stop

    def _on_part_end(self) -> None:
        if self._is_file:
            declared, _ = parse_options_header(self._headers.get(b"content-type"))
            self._found = memoryview(self._body)[self._start : self._stop], self._name, declared
        elif self._field == b"options":
            if self._stop - self._start > _LONGEST_OPTIONS:
                raise self._unreadable(f"options has more than {_LONGEST_OPTIONS} bytes.")
            self.options = bytes(self._body[self._start : self._stop])


def _read_json(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    try:
        # orjson would crash at the end of its memory, where this module raises MemoryError.
        content = json.loads(bytes(data))
    except (ValueError, RecursionError) as error:
        raise MeshError(f"not JSON: {clipped(error)}") from None
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
