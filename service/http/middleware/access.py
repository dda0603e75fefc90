"""Refusing requests from pages of other origins, for another host, and without the key."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import re
import time
from collections.abc import Collection
from http import HTTPStatus
from urllib.parse import unquote

from cachetools import LRUCache
from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from shapespace.service.http.middleware.base import HTTPMiddleware, client_of, request_id_of
from shapespace.service.http.problems import MEDIA_TYPE, description, problem

#: Paths that need no key: health checks of orchestrators, and pages that say nothing about the models.
OPEN = re.compile(r"/|/page/.*|/openapi\.json|/v2/health/(live|ready)")
HEALTH = frozenset({"/v2/health/live", "/v2/health/ready"})
#: Seconds between two answers to wrong keys of one address; longest time that such an answer waits, while further ones
#: are 503 at once; and number of addresses that are remembered.
KEY_INTERVAL, KEY_WAIT, KEY_ADDRESSES = 0.1, 1.0, 10_000


class CrossOrigin(CORSMiddleware):
    """Lets pages of some origins call. Answers of preflights have what all answers have, and refusals are problems."""

    def preflight_response(self, request_headers: Headers) -> Response:
        """Return the answer to a browser that asks whether a page may send a request."""
        answer = super().preflight_response(request_headers)
        if answer.status_code != HTTPStatus.OK:
            what = bytes(answer.body).decode().removeprefix("Disallowed CORS ").replace("headers", "header")
            detail = f"Pages may not send this request: its {what} is not allowed. Allowed are the origins in "
            detail += f"SHAPESPACE_CORS_ORIGINS, {', '.join(self.allow_methods)}, and {', '.join(self.allow_headers)}."
            body, _ = description("cross-origin", detail)
            answer = Response(body, answer.status_code, {"Vary": "Origin"}, MEDIA_TYPE)
        answer.headers["X-Request-ID"] = request_id_of(request_headers)
        answer.headers["X-Content-Type-Options"] = "nosniff"
        return answer


class AcceptWholeAddress(HTTPMiddleware):
    """Reads requests whose target is a whole address (RFC 9112, 3.2.2); its host takes the place of ``Host``."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, with the path alone."""
        if found := re.match(rb"(?i)https?://([^/]+)", scope["raw_path"]):
            scope["raw_path"] = scope["raw_path"][found.end() :] or b"/"
            scope["path"] = unquote(scope["raw_path"].decode("ascii"))
            scope["headers"] = [(name, found[1] if name == b"host" else value) for name, value in scope["headers"]]
        await self.app(scope, receive, send)


class RequireHost(HTTPMiddleware):
    """Refuses requests for another host; h11 refuses those without exactly one ``Host``.

    This prevents DNS rebinding: an attacker lets the name of his web site resolve to the visitor's machine, so that
    his page may call a server there. The name in ``Host`` is still the attacker's. ``hosts`` are the accepted names,
    without ports and in lower case.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str]) -> None:
        super().__init__(app)
        self._hosts = frozenset(hosts)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on requests for this server."""
        given = Headers(scope=scope).get("host")  # HTTP/1.0 has none
        # Orchestrators ask for health by any address they know.
        if given and scope["path"] not in HEALTH and re.sub(r":[0-9]*$", "", given).lower() not in self._hosts:
            detail = f"This server isn't called {given!r}. Use one of its names: {', '.join(sorted(self._hosts))}; "
            await problem(scope, "misdirected", f"{detail}SHAPESPACE_HOSTS adds others.")(scope, receive, send)
        else:
            await self.app(scope, receive, send)


class RequireKey(HTTPMiddleware):
    """Refuses requests without the key, in ``Authorization: Bearer`` or ``X-API-Key``.

    Answers to wrong keys wait, the right key never does. So wrong keys cannot lock out the other clients of an
    address. What prevents guesses is the length of the key.
    """

    def __init__(self, app: ASGIApp, key: SecretStr) -> None:
        super().__init__(app)
        self._digest = _digest(key.get_secret_value())
        #: Time at which the next wrong key from an address may be answered.
        self._next: LRUCache[str, float] = LRUCache(KEY_ADDRESSES)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on requests that have the key or need none."""
        given = _given_key(Headers(scope=scope))
        # Digests have equal lengths, and comparing them takes the same time wherever they differ.
        if OPEN.fullmatch(scope["path"]) or hmac.compare_digest(_digest(given), self._digest):
            await self.app(scope, receive, send)
            return
        kind, detail = "unauthorized", "Send the server's API key: Authorization: Bearer KEY, or X-API-Key: KEY."
        if given:
            now, client = time.monotonic(), client_of(scope)
            turn = max(now, self._next.get(client, 0.0))
            if turn - now > KEY_WAIT:
                kind, detail = "busy", "Too many wrong keys came from this address. Send the right key."
            else:
                self._next[client] = turn + KEY_INTERVAL
                await asyncio.sleep(turn - now)
        await problem(scope, kind, detail)(scope, receive, send)


def _given_key(headers: Headers) -> str:
    scheme, _, given = headers.get("authorization", "").partition(" ")
    return (given if scheme.lower() == "bearer" else headers.get("x-api-key", "")).strip()


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()
