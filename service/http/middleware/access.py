"""Refusing requests for another host, and requests without the key."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import re
import time
from collections import OrderedDict
from collections.abc import Collection

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from shapespace.service.http.middleware.base import HTTPMiddleware, client_of
from shapespace.service.http.problems import problem

#: Paths that need no key: health checks of orchestrators, and pages that say nothing about the models.
OPEN = re.compile(r"/|/page/.*|/openapi\.json|/v2/health/(live|ready)")
HEALTH = frozenset({"/v2/health/live", "/v2/health/ready"})
#: After a wrong key: seconds between two checks for its address, so that no key is found by trying; longest time that a
#: request waits for its check, others get 503 unchecked; and number of addresses that are remembered.
KEY_INTERVAL, KEY_WAIT, KEY_ADDRESSES = 0.1, 1.0, 10_000


class RequireHost(HTTPMiddleware):
    """Refuses requests without exactly one ``Host``, and requests for another host.

    This prevents DNS rebinding: an attacker lets the name of his web site resolve to the visitor's machine, so that
    his page may call a server there. The name in ``Host`` is still the attacker's. ``hosts`` are the accepted names,
    without ports and in lower case; none accepts all.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str]) -> None:
        super().__init__(app)
        self._hosts = frozenset(hosts)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on requests for this server."""
        # Orchestrators ask for health by any address they know.
        if scope["path"] not in HEALTH and (refusal := self._refusal(scope)):
            await problem(scope, *refusal)(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    def _refusal(self, scope: Scope) -> tuple[str, str] | None:
        given = Headers(scope=scope).getlist("host")
        if len(given) > 1 or (not given and scope["http_version"] != "1.0"):
            return "no-host", f"The request has {len(given)} headers Host. Send one."
        if self._hosts and given and re.sub(r":[0-9]*$", "", given[0]).lower() not in self._hosts:
            detail = f"This server isn't called {given[0]!r}. Use one of its names"
            return "misdirected", f"{detail}: {', '.join(sorted(self._hosts))}; SHAPESPACE_HOSTS adds others."
        return None


class RequireKey(HTTPMiddleware):
    """Refuses requests without the key, in ``Authorization: Bearer`` or ``X-API-Key``.

    After a wrong key, the next keys from its address have to wait, right or wrong.
    """

    def __init__(self, app: ASGIApp, key: SecretStr) -> None:
        super().__init__(app)
        self._digest = _digest(key.get_secret_value())
        #: Time at which the next key from an address may be checked.
        self._next: OrderedDict[str, float] = OrderedDict()

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on requests that have the key or need none."""
        if OPEN.fullmatch(scope["path"]):
            await self.app(scope, receive, send)
            return
        if given := _given_key(Headers(scope=scope)):
            client = client_of(scope)
            wait = self._next.get(client, 0.0) - time.monotonic()
            if wait > KEY_WAIT:
                detail = "Too many wrong keys came from this address. Try again after the time in Retry-After."
                await problem(scope, "busy", detail)(scope, receive, send)
                return
            if wait > 0:
                self._postpone(client)
                await asyncio.sleep(wait)
            # Digests have equal lengths, and comparing them takes the same time wherever they differ.
            if hmac.compare_digest(_digest(given), self._digest):
                await self.app(scope, receive, send)
                return
            if wait <= 0:
                self._postpone(client)
        detail = "Send the server's API key: Authorization: Bearer KEY, or X-API-Key: KEY."
        await problem(scope, "unauthorized", detail)(scope, receive, send)

    def _postpone(self, client: str) -> None:
        self._next[client] = max(time.monotonic(), self._next.pop(client, 0.0)) + KEY_INTERVAL
        if len(self._next) > KEY_ADDRESSES:
            self._next.popitem(last=False)


def _given_key(headers: Headers) -> str:
    scheme, _, given = headers.get("authorization", "").partition(" ")
    return (given if scheme.lower() == "bearer" else headers.get("x-api-key", "")).strip()


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()
