"""What every request passes through before the routes, as plain ASGI: contexts and streams stay untouched."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import logging
import re
import time
from collections import OrderedDict
from collections.abc import Collection
from uuid import uuid4

from pydantic import SecretStr
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shapespace.service import logs
from shapespace.service.http.problems import ProblemError, internal_error, problem
from shapespace.service.limits.quota import UPLOADS, Quota, QuotaError, client_name

logger = logging.getLogger(__name__)
REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
#: Paths that need no key: health checks of orchestrators, and pages that say nothing about the models.
OPEN = re.compile(r"/|/page/.*|/openapi\.json|/v2/health/(live|ready)")
#: Most bytes of all answers that are waiting to be sent, and bytes that are sent at once.
ANSWERS, PIECE = 256 * 2**20, 2**18
#: Most characters of a path that are logged.
LONGEST_PATH = 1000
#: After a wrong key the next key from the same address is checked only after this many seconds; a request waits for
#: that at most so many seconds; and so many addresses are remembered.
KEY_INTERVAL, KEY_WAIT, KEY_ADDRESSES = 0.1, 1.0, 10_000
HEALTH = frozenset({"/v2/health/live", "/v2/health/ready"})
#: Paths whose requests are logged at the level of debugging only: they come every few seconds.
QUIET = HEALTH | {"/metrics"}


class AnswerHead:
    """Lets ``HEAD`` be asked wherever ``GET`` is; the server that runs the application leaves out the body."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, as GET if need be."""
        if scope["type"] == "http" and scope["method"] == "HEAD":
            scope = {**scope, "method": "GET", "asked": "HEAD"}
        await self.app(scope, receive, send)


class Observe:
    """Gives each request an id, counts and times it, logs one line about it, and answers where nobody else did.

    Every answer also tells browsers to take it for what it says it is.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on and watch its answer."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        id = given if REQUEST_ID.fullmatch(given) else uuid4().hex
        context = logs.request_id.set(id)
        service, method = scope["app"].state.service, scope.get("asked", scope["method"])
        status = 499  # nginx's number for a client that went away
        answered = False
        began = time.perf_counter()

        async def observed(message: Message) -> None:
            nonlocal status, answered
            if message["type"] == "http.response.start":
                answered = True
                headers = MutableHeaders(scope=message)
                status = message["status"]
                headers["X-Request-ID"] = id
                headers["X-Content-Type-Options"] = "nosniff"
                if service.draining:  # the next request is for another server
                    headers["Connection"] = "close"
            await send(message)

        try:
            await self.app(scope, receive, observed)
        except Exception:
            logger.exception("a mistake of the server")
            if answered:
                raise  # the connection must break: nothing else tells the client
            await internal_error(scope)(scope, receive, observed)
        finally:
            seconds = time.perf_counter() - began
            route = _template(scope)
            service.metrics.answered(route, method, status, seconds)
            # As it came, percent-encoded: a path can't break a line.
            path = scope.get("raw_path", b"")[:LONGEST_PATH].decode("ascii", "replace")
            facts = {"method": method, "path": path, "route": route, "status": status}
            facts |= {"seconds": round(seconds, 6), "client": (scope.get("client") or ["-"])[0]}
            level = logging.DEBUG if route in QUIET else logging.INFO
            logger.log(level, "%s %s %d in %.3f s", method, path, status, seconds, extra=facts)
            logs.request_id.reset(context)


def _template(scope: Scope) -> str:
    """The route's path with its parameters unfilled; one word for all that matches none."""
    if "route" in scope:
        template: str = scope["route"].path
        return template
    return f"{scope['root_path']}/*" if scope.get("root_path") else "unmatched"


class RequireHost:
    """Refuses requests that don't say whom they are for, or are for another server.

    A page of a stranger may call a server on the machine of who looks at it, once the stranger has his own name
    resolve to that machine (DNS rebinding); the name in ``Host`` is still the stranger's.

    Args:
        app: what comes next.
        hosts: names that are meant, without ports and in small letters; none stands for any.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str]) -> None:
        self.app, self._hosts = app, frozenset(hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on what is for this server."""
        # Orchestrators ask for health by whatever address they know.
        if scope["type"] == "http" and scope["path"] not in HEALTH and (refusal := self._refusal(scope)):
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


class RequireKey:
    """Refuses requests without the key, in ``Authorization: Bearer`` or ``X-API-Key``.

    After a wrong key the next of its address has to wait, right or wrong, so that none is found by trying; where too
    many wait, a key isn't looked at.
    """

    def __init__(self, app: ASGIApp, key: SecretStr) -> None:
        self.app, self._digest = app, _digest(key.get_secret_value())
        #: When the next key of an address may be looked at.
        self._next: OrderedDict[str, float] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on what has the key or needs none."""
        if scope["type"] != "http" or OPEN.fullmatch(scope["path"]):
            await self.app(scope, receive, send)
            return
        if given := _given_key(Headers(scope=scope)):
            client = client_name((scope.get("client") or [""])[0])
            wait = self._next.get(client, 0.0) - time.monotonic()
            if wait > KEY_WAIT:
                detail = "Too many wrong keys came from this address. Try again after the time in Retry-After."
                await problem(scope, "busy", detail)(scope, receive, send)
                return
            if wait > 0:
                self._postpone(client)
                await asyncio.sleep(wait)
            # Digests have one length, and comparing them takes the same time wherever they differ.
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


class LimitBody:
    """Refuses request bodies over a limit, announced or not, and compressed ones.

    All bodies that are held at one time have a limit together as well. Starlette has one of its own for a single
    body, but that answers in plain text.

    Args:
        app: what comes next.
        limit: most bytes of a body.
        upload: the same where a mesh file is sent, which is to ``…/encode`` and ``…/fit``.
    """

    def __init__(self, app: ASGIApp, limit: int, upload: int) -> None:
        self.app, self.limit, self.upload = app, limit, upload
        self._held = Quota(UPLOADS * max(limit, upload))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, counting its body as it is read."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = self.upload if scope["path"].endswith(("/encode", "/fit")) else self.limit
        headers = Headers(scope=scope)
        announced = headers.get("content-length", "")
        length = int(announced) if announced.isdecimal() else 0
        encoding = headers.get("content-encoding", "identity")
        client = client_name((scope.get("client") or [""])[0])
        received = 0

        async def limited() -> Message:
            nonlocal received
            if length > limit:
                raise _too_large(limit)
            if encoding.lower() != "identity":
                detail = f"The body is encoded as {encoding}. Send it as it is, without Content-Encoding."
                raise ProblemError("unsupported-media-type", detail)
            message = await receive()
            size = len(message.get("body", b""))
            if received + size > limit:
                raise _too_large(limit)
            try:
                self._held.take(client, size)
            except QuotaError:
                raise ProblemError("busy", "The server holds too many bodies. Try again after Retry-After.") from None
            received += size
            return message

        try:
            await self.app(scope, limited, send)
        finally:
            self._held.give_back(client, received)


class LimitUnreadAnswers:
    """Sends large answers as fast as they are read, and holds so many bytes of them at most.

    Uvicorn takes the body of an answer as a whole, and keeps it until a client has read it.

    Args:
        app: what comes next.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app, self._held = app, Quota(ANSWERS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and its answer in pieces."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        client, held = client_name((scope.get("client") or [""])[0]), 0
        start: Message | None = None
        refused = False

        async def paced(message: Message) -> None:
            nonlocal start, held, refused
            if message["type"] != "http.response.body":
                start = message
                return
            if refused:
                return
            body, more = message.get("body", b""), message.get("more_body", False)
            if start is not None:
                if len(body) > PIECE:
                    try:
                        self._held.take(client, len(body))
                    except QuotaError:
                        refused = True
                        detail = "Too many answers are being read slowly. Try again after the time in Retry-After."
                        await problem(scope, "busy", detail)(scope, receive, send)
                        return
                    held = len(body)
                await send(start)
                start = None
            view = memoryview(body)
            for place in range(0, max(len(view), 1), PIECE):
                last = place + PIECE >= len(view)
                piece = body if len(view) <= PIECE else bytes(view[place : place + PIECE])
                await send({"type": "http.response.body", "body": piece, "more_body": more or not last})

        try:
            await self.app(scope, receive, paced)
        finally:
            self._held.give_back(client, held)


def _too_large(limit: int) -> ProblemError:
    return ProblemError("body-too-large", f"The body is over the limit of {limit} bytes. Send less in each request.")
