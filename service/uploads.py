"""Mesh files in requests: as the body itself or as a part of a form, in a format that something says."""

from __future__ import annotations

from pathlib import PurePath

from fastapi import Request
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from geometry.formats import MESH_FORMATS, OCTET_STREAM
from service.negotiation import declared_type
from service.problems import ProblemError

#: Formats that can be read, by media type.
MEDIA_TYPES = {
    "text/plain": "obj",
    "model/x.stl-ascii": "stl",
    "model/x.stl-binary": "stl",
    "application/sla": "stl",
    "application/ply": "ply",
    "application/x-npz": "npz",
    "application/json": "json",
} | {format.media_type: name for name, format in MESH_FORMATS.items() if format.media_type != OCTET_STREAM}
FORMATS = (*MESH_FORMATS, "json")
_MAGIC = {b"glTF": "glb", b"ply": "ply", b"PK": "npz"}


class _InMemory(MultiPartParser):
    """Keeps parts in memory, whose size the body's limit bounds: there may be no disk to write to."""

    spool_max_size = 2**40


async def read_upload(request: Request, format: str | None) -> tuple[bytes, str]:
    """A mesh file and its format.

    Args:
        request: with the file as body, or as the only file of a ``multipart/form-data`` form.
        format: what ``?format=`` says, which wins; then the content type, the file's name, its first bytes.

    Raises:
        ProblemError: no file, a form that can't be read, or a format that nothing tells or nobody knows.
    """
    declared = declared_type(request.headers)
    if declared == "multipart/form-data":
        file = await _part(request)
        data, declared = await file.read(), declared_type(file.headers)
        suffix = PurePath(file.filename or "").suffix.lstrip(".").lower()
    else:
        data, suffix = await request.body(), ""
    if not data:
        raise ProblemError("invalid-mesh", "The file is empty. Send a mesh file as the body, or as a file of a form.")
    guesses = (
        MEDIA_TYPES.get(declared),
        suffix,
        next((f for magic, f in _MAGIC.items() if data.startswith(magic)), ""),
    )
    found = format or next((guess for guess in guesses if guess in FORMATS), None)
    if found not in FORMATS:
        listed = ", ".join(f"{name} ({kind.media_type})" for name, kind in MESH_FORMATS.items())
        fault = f"There is no format {format!r} here" if format else f"{declared or 'No content type'} tells no format"
        raise ProblemError(
            "unsupported-media-type",
            f"{fault}. Say by ?format= or Content-Type which: {listed}, json (application/json).",
        )
    return data, str(found)


async def _part(request: Request) -> UploadFile:
    try:
        form = await _InMemory(request.headers, request.stream(), max_files=1, max_fields=16).parse()
    except MultiPartException as error:
        raise ProblemError(
            "malformed-request", f"The form can't be read: {error.message} Send one file in it."
        ) from None
    files = [value for value in form.values() if isinstance(value, UploadFile)]
    if not files:
        raise ProblemError("invalid-mesh", "The form holds no file. Send the mesh file as one of its fields.")
    return files[0]
