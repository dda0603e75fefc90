"""Compression of answers in text formats."""

from __future__ import annotations

import re

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shapespace.service.http.middleware.base import HTTPMiddleware
from shapespace.service.http.negotiation import listed

#: Binary formats: floating-point numbers that gzip makes hardly smaller, and archives. Events, which must not wait.
EXCLUDED = (
    "application/octet-stream", "application/zip", "image/png", "image/webp", "font/*", "model/gltf-binary",
    "model/stl", "model/vnd.usdz+zip", "text/event-stream",
)  # fmt: skip
#: End of the entity tag of a compressed answer.
SUFFIX = '-gzip"'
#: A client that accepts gzip, by a weight above 0.
ACCEPTED = re.compile(r"(^|,)\s*(x-)?gzip\s*(;\s*q\s*=(?!\s*0(\.0*)?\s*(,|$))|,|$)")


class Compress(HTTPMiddleware):
    """Compresses text answers for clients that accept gzip; large ones in threads.

    A compressed answer is another representation, so its entity tag has a suffix (RFC 9110, 8.8.3).
    """

    def __init__(self, app: ASGIApp) -> None:
        super().__init__(app)
        # Level 4 takes a third of the time of level 9, for a few per cent more bytes.
        self._gzip = GZipMiddleware(app, compresslevel=4, thread_minimum_size=2**15, exclude_content_types=EXCLUDED)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, with the tags that routes know, and compress its answer."""
        headers = Headers(scope=scope)
        known = listed(headers, "if-none-match") or ""
        accepted = ACCEPTED.search((listed(headers, "accept-encoding") or "").lower())
        scope["headers"] = [*scope["headers"]]  # in the same scope, in which the router notes the route
        changed = MutableHeaders(scope=scope)
        changed["accept-encoding"] = "gzip" if accepted else "identity"  # what the middleware looks for
        if SUFFIX in known:
            changed["if-none-match"] = known.replace(SUFFIX, '"')

        async def tagged(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                tag = headers.get("etag", "")
                unchanged = message["status"] == 304 and tag[:-1] + SUFFIX in known
                if unchanged:
                    headers.add_vary_header("Accept-Encoding")
                if tag and (unchanged or "content-encoding" in headers):
                    headers["etag"] = tag[:-1] + SUFFIX
            await send(message)

        await self._gzip(scope, receive, tagged)
