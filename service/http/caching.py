"""Entity tags, and a cache of recent answers."""

from __future__ import annotations

import hashlib
from contextlib import suppress

from cachetools import LRUCache
from fastapi import Request, Response

from shapespace import __version__
from shapespace.service.http.negotiation import listed
from shapespace.service.use_cases.batch import EncodedFile


def entity_tag(*parts: str | bytes) -> str:
    """A strong entity tag of the product's version and of all else that the bytes of an answer depend on."""
    digest = hashlib.sha256()
    for part in (__version__, "numpy", *parts):  # the constant keeps the tags that caches know
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "big") + data)
    return f'"{digest.hexdigest()[:32]}"'


def cache_headers(tag: str) -> dict[str, str]:
    """Return headers that let a client keep an answer and ask whether it is still valid."""
    return {"ETag": tag, "Vary": "Accept", "Cache-Control": "no-cache"}


def not_modified(request: Request, tag: str) -> Response | None:
    """Return 304 if the client has the answer already."""
    # "*" matches nothing: whether a code has a shape is known only once the shape has been computed.
    known = {part.strip().removeprefix("W/") for part in (listed(request.headers, "if-none-match") or "").split(",")}
    return Response(status_code=304, headers=cache_headers(tag)) if tag in known else None


class AnswerCache(LRUCache[str, EncodedFile]):
    """The most recently used answers by entity tag, of ``limit`` bytes together; for the event loop only."""

    def __init__(self, limit: int) -> None:
        super().__init__(limit, getsizeof=_size)

    def keep(self, tag: str, answer: EncodedFile) -> None:
        """Keep an answer in place of the least recently used ones, unless it is over the limit by itself."""
        with suppress(ValueError):
            self[tag] = answer


def _size(answer: EncodedFile) -> int:
    """Return the approximate number of bytes of an answer in memory."""
    assert isinstance(answer.content, bytes)  # noqa: S101 - narrows the type: what is cached is small
    return len(answer.content) + 2048
