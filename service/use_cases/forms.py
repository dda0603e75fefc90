"""Forms with a file: a parser of ``multipart/form-data`` that copies no file."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, MultipartState, parse_options_header

from shapespace.files.limits import as_utf8, label
from shapespace.service.refusals import RefusedError

#: Name of the field that holds options as JSON.
OPTIONS = "options"
#: Most characters of a Content-Type or Content-Disposition header.
LONGEST_HEADER = 1000
#: Most fields of a form beside the file, and most bytes of them together.
_MOST_FIELDS, _LONGEST_FIELDS = 16, 2**18


@dataclass
class FormPart:
    """A part of a form.

    Attributes:
        name: name of the field.
        file_name: name of the file; None if the part is no file.
        media_type: declared media type, or an empty string.
        data: content.
    """

    name: str
    file_name: str | None
    media_type: str
    data: memoryview


def read_form(
    body: bytes | bytearray, boundary: bytes | None, known: Collection[str] | None
) -> tuple[FormPart | None, dict[str, str]]:
    """Return the file of a form, if there is one, and the texts of the fields by name.

    A file named ``options`` is a field too. So is a file named as another field if there is one more file.

    Args:
        body: the form.
        boundary: boundary of its parts; None if the header names none.
        known: names of the fields that the call has, beside ``options``; None accepts all.

    Raises:
        RefusedError: the form can't be read, or holds several files, or a field that the call doesn't have.
    """
    parts = _Parser(body, boundary).parts
    files = [part for part in parts if part.file_name is not None and part.name != OPTIONS]
    if len(files) > 1:
        files = [part for part in files if part.name not in (known or ())]
    if len(files) > 1:
        raise _unreadable("Too many files. Maximum number of files is 1.", "Send several meshes as one ZIP archive.")
    file = files[0] if files else None
    fields: dict[str, str] = {}
    for part in parts:
        if file is None or part is file:
            continue
        if known is not None and part.name not in (*known, OPTIONS):
            there = ", ".join((*known, OPTIONS))
            raise RefusedError(
                "invalid-request", f"There is no field {label(part.name) or ''!r} here: choose among {there}."
            )
        if part.name in fields:
            raise RefusedError("invalid-request", f"The form has the field {part.name!r} twice. Send it once.")
        fields[part.name] = _text(part)
    return file, fields


def _text(part: FormPart) -> str:
    try:
        return str(as_utf8(part.data), "utf-8")
    except ValueError:
        raise RefusedError(
            "invalid-request", f"The field {part.name!r} is not text in UTF-8. Send it in UTF-8."
        ) from None


def _unreadable(why: str, remedy: str = "Send one file in it.") -> RefusedError:
    return RefusedError("malformed-request", f"The form can't be read: {why} {remedy}")


class _Parser:
    """Parser of the parts of a form."""

    def __init__(self, body: bytes | bytearray, boundary: bytes | None) -> None:
        self.parts: list[FormPart] = []
        self._body, self._start, self._stop, self._short = memoryview(body), 0, 0, 0
        self._headers: dict[bytes, bytes] = {}
        self._header = b""
        if boundary is None:
            raise _unreadable("Missing boundary in multipart.")
        if body.count(b"\r\n--" + boundary) > 2 * _MOST_FIELDS:
            raise _unreadable("Too many parts.")
        try:
            parser = MultipartParser(
                boundary,
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
            parser.write(body)  # type: ignore[arg-type]
        except FormParserError:
            raise _unreadable("Invalid multipart data.") from None
        if parser.state != MultipartState.END:
            raise _unreadable("It ends before its last boundary.", "Send all of it.")

    def _on_header_field(self, data: bytes, start: int, stop: int) -> None:
        self._header = bytes(data[start : min(stop, start + LONGEST_HEADER)]).lower()

    def _on_header_value(self, data: bytes, start: int, stop: int) -> None:
        self._headers[self._header] = bytes(data[start : min(stop, start + LONGEST_HEADER)])

    def _on_headers_finished(self) -> None:
        _, options = parse_options_header(self._headers.get(b"content-disposition"))
        if b"name" not in options:
            raise _unreadable('The Content-Disposition header field "name" must be provided.')
        if len(self.parts) > _MOST_FIELDS:
            raise _unreadable(f"Too many fields. Maximum number of fields is {_MOST_FIELDS}.")
        media_type, _ = parse_options_header(self._headers.get(b"content-type"))
        file = options.get(b"filename")
        name = options[b"name"].decode(errors="replace")
        file_name = None if file is None else file.decode(errors="replace")
        self.parts.append(FormPart(name, file_name, media_type.decode("latin-1"), self._body[:0]))
        self._start, self._stop = 0, 0

    def _on_part_data(self, data: bytes, start: int, stop: int) -> None:
        self._start, self._stop = self._start or start, stop

    def _on_part_end(self) -> None:
        part = self.parts[-1]
        part.data = self._body[self._start : self._stop]
        if part.file_name is None or part.name == OPTIONS:
            self._short += len(part.data)
        if self._short > _LONGEST_FIELDS:
            raise _unreadable(f"{label(part.name)} has more than {_LONGEST_FIELDS} bytes.")
