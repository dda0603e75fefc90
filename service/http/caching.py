"""Entity tags, and the answers given last, so that asking for one again costs nothing."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from cachetools import LRUCache
from fastapi import Request, Response

from shapespace import __version__
from shapespace.coordinates import compiled


def entity_tag(*parts: str | bytes) -> str:
    """A strong entity tag of all that the bytes of an answer depend on.

    The product's version is added, and which code computes: compiled loops round otherwise than NumPy does.
    """
    digest = hashlib.sha256()
    for part in (__version__, "compiled" if compiled.AVAILABLE else "numpy", *parts):
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "big") + data)
    return f'"{digest.hexdigest()[:32]}"'


def cache_headers(tag: str) -> dict[str, str]:
    """Headers that let a client keep an answer and ask whether it still holds."""
    return {"ETag": tag, "Vary": "Accept", "Cache-Control": "no-cache"}


def not_modified(request: Request, tag: str) -> Response | None:
    """304 where the client has the answer already."""
    # Not where it is "*": whether there is a shape at all is known only once it has been found.
    known = {part.strip().removeprefix("W/") for part in request.headers.get("if-none-match", "").split(",")}
    return Response(status_code=304, headers=cache_headers(tag)) if tag in known else None


@dataclass(frozen=True)
class CachedAnswer:
    """A file as it was answered.

    Attributes:
        content: its bytes.
        headers: those that belong to it, whoever asks.
    """

    content: bytes
    headers: Mapping[str, str]

    @property
    def size(self) -> int:
        """Bytes that keeping it takes, nearly."""
        return len(self.content) + sum(len(name) + len(value) for name, value in self.headers.items()) + 1024


class AnswerCache(LRUCache[str, CachedAnswer]):
    """Answers by entity tag, which names all that their bytes depend on, as many of the last ones as fit.

    Touched from the event loop only.

    Args:
        limit: most bytes of all of them together.
    """

    def __init__(self, limit: int) -> None:
        super().__init__(limit, getsizeof=lambda answer: answer.size)

    def keep(self, tag: str, answer: CachedAnswer) -> None:
        """Keep an answer instead of those that nobody has asked for the longest, unless it alone is too large."""
        with suppress(ValueError):
            self[tag] = answer
