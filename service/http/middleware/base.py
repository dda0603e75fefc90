"""Parts that all middleware shares."""

from __future__ import annotations

import re
from uuid import uuid4

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from shapespace.service.limits.quota import client_name

#: Ids that a client may choose; others are replaced.
REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")


class HTTPMiddleware:
    """Middleware for HTTP requests, as plain ASGI, which leaves contexts and streams untouched."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request; pass on everything else, as the start and the end of the server."""
        if scope["type"] == "http":
            await self.handle(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        raise NotImplementedError


def request_id_of(headers: Headers) -> str:
    """Return the id of a request: its own, if that is a good one, or a new one."""
    given = headers.get("x-request-id", "")
    return given if REQUEST_ID.fullmatch(given) else uuid4().hex


def client_of(scope: Scope) -> str:
    """Return the client whose quotas a request counts for; empty where the address is unknown."""
    return client_name((scope.get("client") or [""])[0])
