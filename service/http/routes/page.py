"""The page for people."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from fastapi.responses import FileResponse
from starlette.middleware.gzip import GZipMiddleware
from starlette.responses import Response
from starlette.routing import BaseRoute, Mount
from starlette.staticfiles import StaticFiles

FOLDER = Path(__file__).parents[2] / "page"
_CACHING = {"Cache-Control": "no-cache"}  # by entity tag: modules of two versions must not meet

router = APIRouter(include_in_schema=False)


@router.api_route("/", methods=["GET", "HEAD"])
async def page() -> FileResponse:
    """Shapes to move by hand."""
    headers = {"Content-Security-Policy": _policy(), **_CACHING}
    return FileResponse(FOLDER / "index.html", headers=headers, media_type="text/html")


def assets() -> BaseRoute:
    """Styles and scripts of the page, compressed."""
    return Mount("/page", GZipMiddleware(_Assets(directory=FOLDER)), name="page")


@cache
def _policy() -> str:
    """Everything the page needs comes from this server; the import map, an inline script, goes by its digest."""
    maps = re.findall(r'<script type="importmap">(.*?)</script>', (FOLDER / "index.html").read_text("utf-8"), re.DOTALL)
    digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in maps)
    scripts = " ".join(["'self'", *(f"'sha256-{digest}'" for digest in digests)])
    return f"default-src 'self'; script-src {scripts}; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"


class _Assets(StaticFiles):
    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers.update(_CACHING)
        return response
