"""Compression of answers in text formats."""

from __future__ import annotations

import re

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shapespace.service.http.middleware.base import HTTPMiddleware

#: Binary formats: floating-point numbers that gzip makes hardly smaller, and archives. Events, which must not wait.
EXCLUDED = (
    "application/octet-stream", "application/zip", "image/png", "image/webp", "font/*", "model/gltf-binary",
    "model/stl", "model/vnd.usdz+zip", "text/event-stream",
)  # fmt: skip
#: End of the entity tag of a compressed answer.
SUFFIX = '-gzip"'
#: A client that refuses gzip.
REFUSED = re.compile(r"gzip\s*;\s*q=0(\.0*)?\s*(,|$)")


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
        known = Headers(scope=scope).get("if-none-match", "")
        if SUFFIX in known:
            scope["headers"] = [*scope["headers"]]  # in the same scope, in which the router notes the route
            MutableHeaders(scope=scope)["if-none-match"] = known.replace(SUFFIX, '"')

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

        refused = REFUSED.search(Headers(scope=scope).get("accept-encoding", "").lower())
        await (self.app if refused else self._gzip)(scope, receive, tagged)
