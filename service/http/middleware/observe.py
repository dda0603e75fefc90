"""Ids, metrics and log lines of requests, and ``HEAD``."""

from __future__ import annotations

import asyncio
import logging
import time
from http import HTTPStatus

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import Message, Receive, Scope, Send

from shapespace.service import logs
from shapespace.service.http.middleware.access import HEALTH
from shapespace.service.http.middleware.base import HTTPMiddleware, request_id_of
from shapespace.service.http.problems import problem

#: Named in docs/how-to/operate.md, so that operators can filter by it.
logger = logging.getLogger("shapespace.service.http.middleware")
#: Most characters of a path in the log.
LONGEST_PATH = 1000
#: Paths whose requests are logged at level DEBUG only, because they come every few seconds.
QUIET = HEALTH | {"/metrics"}


class Observe(HTTPMiddleware):
    """Gives each request an id, counts and times it, and logs one line about it.

    ``HEAD`` is answered as ``GET``; uvicorn leaves out the body. An unexpected exception is answered as an internal
    error. Every answer tells browsers not to guess its type.
    """

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on and watch its answer."""
        id = request_id_of(Headers(scope=scope))
        context = logs.request_id.set(id)
        service, method = scope["app"].state.service, scope["method"]
        scope = {**scope, "method": "GET"} if method == "HEAD" else scope
        status = 499  # the status of nginx for a client that closed the connection
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
                headers.update(_version_headers(scope, status))
                if service.draining:  # the client should send its next request to another server
                    headers["Connection"] = "close"
            await send(message)

        try:
            await self.app(scope, receive, observed)
        except asyncio.CancelledError:  # the server ends
            if not answered:
                detail = "The server is about to end. Send the request to another one, or again in a moment."
                await problem(scope, "not-ready", detail)(scope, receive, observed)
        except Exception:
            logger.exception("internal error")
            if answered:
                raise  # breaks the connection, the only way left to tell the client
            detail = (
                "The server has an internal error. Try again. If it happens again, report it with the "
                "X-Request-ID of this answer, which leads to it in the log."
            )
            await problem(scope, "internal-error", detail)(scope, receive, observed)  # only the log has the traceback
        finally:
            seconds = time.perf_counter() - began
            # With its parameters unfilled, and one word for all paths without a route.
            unmatched = f"{scope['root_path']}/*" if scope.get("root_path") else "unmatched"
            route = scope["route"].path if "route" in scope else unmatched
            model = scope.get("state", {}).get("model")
            name, version = (model.name, model.version) if model else ("", "")
            service.metrics.answered(route, method, status, seconds, name, version)
            # As received, percent-encoded, so that a path cannot break a line.
            path = scope.get("raw_path", b"")[:LONGEST_PATH].decode("ascii", "replace")
            facts = {"method": method, "path": path, "route": route, "status": status}
            facts |= {"seconds": round(seconds, 6), "client": (scope.get("client") or ["-"])[0]}
            level = logging.DEBUG if route in QUIET else logging.INFO
            logger.log(level, "%s %s %d in %.3f s", method, path, status, seconds, extra=facts)
            logs.request_id.reset(context)


def _version_headers(scope: Scope, status: int) -> dict[str, str]:
    """Return headers that say which version of a model answers; none where no model does."""
    state = scope.get("state", {})
    if "model" not in state:
        return {}
    version = state["model"].version
    found = {"Model-Version": version}
    query = scope["query_string"].decode("ascii", "ignore")
    # Of a POST the address alone does not get the answer again, and below /v2 the version is part of the path.
    readable = state["chosen"] and scope["method"] == "GET" and scope["path"].startswith("/v1/")
    if readable and status < HTTPStatus.BAD_REQUEST and len(query) < LONGEST_PATH:
        path = scope.get("raw_path", b"").decode("ascii", "ignore")
        found["Content-Location"] = f"{path}?{query}&version={version}" if query else f"{path}?version={version}"
    return found
