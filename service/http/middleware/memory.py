"""Limits on the memory of request bodies and of answers that clients have not read yet."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shapespace.service.http.middleware.base import HTTPMiddleware, client_of
from shapespace.service.http.problems import ProblemError, problem
from shapespace.service.limits.quota import UPLOADS, Quota, QuotaError

#: Most bytes of all answers that wait to be read.
UNREAD_BYTES = 256 * 2**20
#: Bytes of an answer that are sent at once.
PIECE_BYTES = 2**18


class LimitBody(HTTPMiddleware):
    """Refuses request bodies over a limit, announced or not, and compressed bodies.

    All bodies in memory have a limit together as well; mesh files, for ``…/encode`` and ``…/fit``, have their own,
    ``upload``. Starlette's own limit for a single body answers in plain text.
    """

    def __init__(self, app: ASGIApp, limit: int, upload: int) -> None:
        super().__init__(app)
        self._limit, self._upload = limit, upload
        self._held = Quota(UPLOADS * max(limit, upload))

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and count its body while it is read."""
        limit = self._upload if scope["path"].endswith(("/encode", "/fit")) else self._limit
        headers = Headers(scope=scope)
        announced = headers.get("content-length", "")
        length = int(announced) if announced.isdecimal() else 0
        encoding = headers.get("content-encoding", "identity")
        client = client_of(scope)
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


class LimitUnreadAnswers(HTTPMiddleware):
    """Sends large answers as fast as they are read, and limits the memory that unread answers take together.

    Uvicorn takes the body of an answer as a whole, and keeps it until a client has read it.
    """

    def __init__(self, app: ASGIApp) -> None:
        super().__init__(app)
        self._held = Quota(UNREAD_BYTES)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and send its answer in pieces."""
        client, held = client_of(scope), 0
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
                if len(body) > PIECE_BYTES:
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
            for place in range(0, max(len(view), 1), PIECE_BYTES):
                last = place + PIECE_BYTES >= len(view)
                piece = body if len(view) <= PIECE_BYTES else bytes(view[place : place + PIECE_BYTES])
                await send({"type": "http.response.body", "body": piece, "more_body": more or not last})

        try:
            await self.app(scope, receive, paced)
        finally:
            self._held.give_back(client, held)


def _too_large(limit: int) -> ProblemError:
    return ProblemError("body-too-large", f"The body is over the limit of {limit} bytes. Send less in each request.")
