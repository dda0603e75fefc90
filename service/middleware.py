"""What every request passes through before the routes, as plain ASGI: contexts and streams stay untouched."""

from __future__ import annotations

import hashlib
import hmac
import logging
import re
import time
from uuid import uuid4

from pydantic import SecretStr
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import logs
from service.problems import ProblemError, internal_error, problem

logger = logging.getLogger(__name__)
REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
#: What answers without a key: orchestrators ask for health, and the others say nothing about the models.
OPEN = re.compile(r"/|/page/.*|/openapi\.json|/v2/health/(live|ready)")
#: Called every few seconds, so that their lines are of no interest.
QUIET = frozenset({"/v2/health/live", "/v2/health/ready", "/metrics"})


class AnswerHead:
    """Lets ``HEAD`` be asked wherever ``GET`` is; the server that runs the application leaves out the body."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, as GET if need be."""
        if scope["type"] == "http" and scope["method"] == "HEAD":
            scope = {**scope, "method": "GET"}
        await self.app(scope, receive, send)


class Observe:
    """Gives each request an id, counts and times it, logs one line about it, and answers where nobody else did."""

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
        service = scope["app"].state.service
        status, timing = 499, ""  # nginx's number for a client that went away
        answered = False
        began = time.perf_counter()

        async def observed(message: Message) -> None:
            nonlocal status, timing, answered
            if message["type"] == "http.response.start":
                answered = True
                headers = MutableHeaders(scope=message)
                status, timing = message["status"], headers.get("server-timing", "")
                headers["X-Request-ID"] = id
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
            service.metrics.answered(route, scope["method"], status, seconds, timing)
            # As it came, percent-encoded: a path can't break a line.
            path = scope.get("raw_path", b"").decode("ascii", "replace")
            facts = {"method": scope["method"], "path": path, "route": route, "status": status}
            facts |= {"seconds": round(seconds, 6), "client": (scope.get("client") or ["-"])[0]}
            level = logging.DEBUG if route in QUIET else logging.INFO
            logger.log(level, "%s %s %d in %.3f s", scope["method"], path, status, seconds, extra=facts)
            logs.request_id.reset(context)


def _template(scope: Scope) -> str:
    """The route's path with its parameters unfilled; one word for all that matches none."""
    if "route" in scope:
        template: str = scope["route"].path
        return template
    return f"{scope['root_path']}/*" if scope.get("root_path") else "unmatched"


class RequireKey:
    """Refuses requests without the key, in ``Authorization: Bearer`` or ``X-API-Key``."""

    def __init__(self, app: ASGIApp, key: SecretStr) -> None:
        self.app, self._digest = app, _digest(key.get_secret_value())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on what has the key or needs none."""
        if scope["type"] != "http" or OPEN.fullmatch(scope["path"]) or self._has_key(Headers(scope=scope)):
            await self.app(scope, receive, send)
            return
        detail = "Send the server's API key: Authorization: Bearer KEY, or X-API-Key: KEY."
        await problem(scope, "unauthorized", detail)(scope, receive, send)

    def _has_key(self, headers: Headers) -> bool:
        scheme, _, given = headers.get("authorization", "").partition(" ")
        if scheme.lower() != "bearer":
            given = headers.get("x-api-key", "")
        # Digests have one length, and comparing them takes the same time wherever they differ.
        return hmac.compare_digest(_digest(given.strip()), self._digest)


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()


class LimitBody:
    """Refuses request bodies over a limit, announced or not, and compressed ones.

    Starlette has one of its own, but that answers in plain text.

    Args:
        app: what comes next.
        limit: most bytes of a body.
        upload: the same where a mesh file is sent, which is to ``…/encode``.
    """

    def __init__(self, app: ASGIApp, limit: int, upload: int) -> None:
        self.app, self.limit, self.upload = app, limit, upload

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, counting its body as it is read."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = self.upload if scope["path"].endswith("/encode") else self.limit
        headers = Headers(scope=scope)
        announced = headers.get("content-length", "")
        length = int(announced) if announced.isdecimal() else 0
        encoding = headers.get("content-encoding", "identity")
        received = 0

        async def limited() -> Message:
            nonlocal received
            if length > limit:
                raise _too_large(limit)
            if encoding.lower() != "identity":
                detail = f"The body is encoded as {encoding}. Send it as it is, without Content-Encoding."
                raise ProblemError("unsupported-media-type", detail)
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise _too_large(limit)
            return message

        await self.app(scope, limited, send)


def _too_large(limit: int) -> ProblemError:
    return ProblemError("body-too-large", f"The body is over the limit of {limit} bytes. Send less in each request.")
