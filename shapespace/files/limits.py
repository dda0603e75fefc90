"""Limits on the size of a mesh, text from files (its encoding, and names in messages), and errors of the system."""

from __future__ import annotations

import errno
import re
import struct
import sys
from dataclasses import dataclass
from pathlib import Path

from shapespace.mesh.triangle_mesh import MeshError


@dataclass(frozen=True)
class Limits:
    """Largest size of a mesh; by default there is no limit."""

    vertices: int = sys.maxsize  # largest number of vertices
    faces: int = sys.maxsize  # largest number of triangles

    def check(self, vertices: int, faces: int) -> None:
        """Raise MeshError if a mesh has more vertices or faces."""
        if vertices > self.vertices:
            raise MeshError(f"it has more than {self.vertices} vertices")
        if faces > self.faces:
            raise MeshError(f"it has more than {self.faces} faces")


#: For files of the user's own.
UNLIMITED = Limits()


#: Encodings by their byte-order marks. The mark of UTF-32 begins with the mark of UTF-16.
_MARKS = {b"\xff\xfe\0\0": "utf-32", b"\0\0\xfe\xff": "utf-32", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}


def as_utf8(data: memoryview) -> memoryview:
    """Return a text in UTF-8 without its byte-order mark; raises ValueError if it is damaged UTF-16 or UTF-32.

    UTF-16 without a mark is recognised by its first four characters, which must be ASCII.
    """
    start = bytes(data[:8])
    if start.startswith(b"\xef\xbb\xbf"):
        return data[3:]
    encoding = next((name for mark, name in _MARKS.items() if start.startswith(mark)), None)
    if encoding is None and len(start) == 8 and start.count(0) == 4:
        encoding = {start[1::2]: "utf-16-le", start[::2]: "utf-16-be"}.get(bytes(4))
    return memoryview(str(data, encoding).encode()) if encoding else data


def label(text: object) -> str | None:
    """Return a name from a file on one line, shortened; None if it has no printable character."""
    return clipped("".join(c if c.isprintable() else " " for c in str(text)[:1000])) or None


def reason(error: Exception) -> str:
    """Return the message of an error on one line, shortened, unless it repeats what stands in the file."""
    line = clipped(error, 300)
    unfit = (
        isinstance(error, LookupError | TypeError | AttributeError | RecursionError | struct.error)
        or not line.isprintable()
        or re.search(r"\\x[0-9a-f]|\\0|\ufffd|codec can't|invalid literal|could not convert", line)
    )
    return "it is damaged, or another kind of file" if unfit else line


def clipped(text: object, most: int = 100) -> str:
    """Return text from a file on one line, shortened to ``most`` characters."""
    line = " ".join(str(text)[:1000].split())
    return line if len(line) <= most else f"{line[:most]}…"


def read_plain(path: Path) -> bytes:
    """Return the content of a file; raises OSError, also for a device or a pipe, which might never end."""
    if path.name == str(path) == "-" and not path.exists():
        raise OSError(errno.EINVAL, "standard input is not read; save its content in a file first", str(path))
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "it is a device or a pipe; save its content in a file first", str(path))
    return path.read_bytes()


#: Sentences about a file or folder, by the number of the system's error.
_SYSTEM_ERRORS = {
    errno.ENOENT: "there is no such file or folder; check its name",
    errno.EISDIR: "it is a folder, but a file is needed",
    errno.ENOTDIR: "it is a file or lies below one, but a folder is needed",
    errno.EACCES: "you may not read or write there; change its permissions, or choose another place",
    errno.EPERM: "you may not read or write there; change its permissions, or choose another place",
    errno.EROFS: "the disk can't be written to; choose another place",
    errno.ENOSPC: "the disk is full; free some space, then give the same command again",
    errno.EDQUOT: "your quota on this disk is full; free some space, then give the same command again",
    errno.ENAMETOOLONG: "its name is too long; choose a shorter one",
    errno.ELOOP: "its links lead back to themselves; name the file itself",
    errno.EMFILE: "too many files are open at once; raise the limit with ulimit -n",
}


def in_words(error: OSError, *, named: bool = True) -> str:
    """Return what the system refused and what to do, without the error's number.

    With ``named`` the sentence begins with the file, if the error has one.
    """
    words = _SYSTEM_ERRORS.get(error.errno or 0) or error.strerror or str(error) or type(error).__name__
    return f"{error.filename}: {words}" if named and error.filename is not None else words
