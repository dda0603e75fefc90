"""What every request passes through before the routes."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import ProblemError


class BodyLimit:
    """Refuses request bodies over a limit, announced or not.

    Starlette has one of its own, but that answers in plain text.
    """

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self.app, self.limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, counting its body as it is read."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        announced = Headers(scope=scope).get("content-length", "")
        length = int(announced) if announced.isdecimal() else 0
        received = 0

        async def limited() -> Message:
            nonlocal received
            if length > self.limit:
                raise self._too_large()
            message = await receive()
            received += len(message.get("body", b""))
            if received > self.limit:
                raise self._too_large()
            return message

        await self.app(scope, limited, send)

    def _too_large(self) -> ProblemError:
        return ProblemError(
            "body-too-large",
            f"The body is over the limit of {self.limit} bytes. Send fewer codes in each request.",
        )
