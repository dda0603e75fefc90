"""Limits on the memory of request bodies and of answers that clients have not read yet."""

from __future__ import annotations

import zlib

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shapespace.service.http.middleware.base import HTTPMiddleware, client_of
from shapespace.service.http.problems import problem
from shapespace.service.limits.quota import UPLOADS, Quota
from shapespace.service.refusals import RefusedError

#: Most bytes of all answers that wait to be read.
UNREAD_BYTES = 256 * 2**20
#: Bytes of an answer that are sent at once, and of a compressed body that are unpacked at once.
PIECE_BYTES = 2**18
#: Most members of a gzip body (RFC 1952, 2.2): an empty member has few bytes, but costs as much as a large one.
MOST_MEMBERS = 4000
#: Window sizes by which zlib tells the formats of ``Content-Encoding``.
WINDOWS = {"gzip": 16 + zlib.MAX_WBITS, "x-gzip": 16 + zlib.MAX_WBITS, "deflate": zlib.MAX_WBITS}


class LimitBody(HTTPMiddleware):
    """Refuses request bodies over a limit, announced or not, and unpacks those compressed by gzip or deflate.

    The limit holds for the unpacked body. All bodies in memory have a limit together as well. Mesh files,
    for ``…/encode`` and ``…/fit``, have their own, ``upload``. Starlette's own limit for one body answers in plain
    text.
    """

    def __init__(self, app: ASGIApp, limit: int, upload: int) -> None:
        super().__init__(app)
        self._limit, self._upload = limit, upload
        self._held = Quota(UPLOADS * max(limit, upload), "The server holds too many bodies")

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and count its body while it is read."""
        limit = self._upload if scope["path"].endswith(("/encode", "/fit")) else self._limit
        headers = Headers(scope=scope)
        announced = headers.get("content-length", "")
        length = int(announced) if announced.isdecimal() else 0
        encoding = headers.get("content-encoding", "identity").strip().lower()
        given = _Unpacked(receive, WINDOWS[encoding]) if encoding in WINDOWS else receive
        client = client_of(scope)
        received = 0

        async def limited() -> Message:
            nonlocal received
            if length > limit:
                raise _too_large(limit)
            if encoding not in ("identity", *WINDOWS):
                detail = (
                    "The body has a Content-Encoding that isn't read here. Send it uncompressed, or with gzip "
                    "or deflate."
                )
                raise RefusedError("unsupported-media-type", detail)
            message = await given()
            size = len(message.get("body", b""))
            if received + size > limit:
                raise _too_large(limit)
            self._held.take(client, size)
            received += size
            return message

        try:
            await self.app(scope, limited, send)
        finally:
            self._held.give_back(client, received)


class _Unpacked:
    """The messages of a compressed body, unpacked in pieces of a size that holds up no other request."""

    def __init__(self, receive: Receive, window: int) -> None:
        self._receive, self._window = receive, window
        self._unpacker = zlib.decompressobj(window)
        self._members = MOST_MEMBERS if window > zlib.MAX_WBITS else 1
        self._packed = b""  # what is received and not unpacked yet
        self._more = True  # whether further messages follow
        self._full = False  # whether the last piece was as large as pieces may be, so that more may be left of it

    async def __call__(self) -> Message:
        if not self._full:
            message = await self._receive()
            if message["type"] != "http.request":
                return message
            self._packed, self._more = message.get("body", b""), message.get("more_body", False)
        try:
            body = self._piece()
        except zlib.error:
            raise _damaged() from None
        self._full = len(body) == PIECE_BYTES
        more = self._more or self._full
        if not (more or self._unpacker.eof):
            raise _damaged()
        return {"type": "http.request", "body": body, "more_body": more}

    def _piece(self) -> bytes:
        """Unpack the next piece, over the ends of members."""
        body = bytearray()
        while True:
            if self._packed and self._unpacker.eof:
                self._unpacker, self._members = zlib.decompressobj(self._window), self._members - 1
                if not self._members:
                    raise _damaged()
            body += self._unpacker.decompress(self._packed, PIECE_BYTES - len(body))
            self._packed = self._unpacker.unused_data or self._unpacker.unconsumed_tail
            if not self._packed or len(body) == PIECE_BYTES:
                return bytes(body)


class LimitUnreadAnswers(HTTPMiddleware):
    """Sends large answers as fast as they are read, and limits the memory that unread answers take together.

    Uvicorn takes the body of an answer as a whole, and keeps it until a client has read it.
    """

    def __init__(self, app: ASGIApp) -> None:
        super().__init__(app)
        self._held = Quota(UNREAD_BYTES, "Too many answers are being read slowly")

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
                    except RefusedError as error:
                        refused = True
                        await problem(scope, error.kind, str(error))(scope, receive, send)
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


def _damaged() -> RefusedError:
    detail = "The body isn't compressed as its Content-Encoding says, or it is cut short. Send all of it."
    return RefusedError("malformed-request", detail)


def _too_large(limit: int) -> RefusedError:
    return RefusedError("body-too-large", f"The body is over the limit of {limit} bytes. Send less in each request.")
