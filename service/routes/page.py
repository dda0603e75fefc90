"""The page for people."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse
from starlette.routing import BaseRoute, Mount
from starlette.staticfiles import StaticFiles

FOLDER = Path(__file__).parent.parent / "page"
#: Everything the page needs comes from this server.
SECURITY = {"Content-Security-Policy": "default-src 'self'; base-uri 'none'; frame-ancestors 'none'"}

router = APIRouter(include_in_schema=False)


@router.api_route("/", methods=["GET", "HEAD"])
async def page() -> FileResponse:
    """What this is, which models there are, and calls to copy."""
    return FileResponse(FOLDER / "index.html", headers=SECURITY, media_type="text/html")


def assets() -> BaseRoute:
    """Styles and scripts of the page."""
    return Mount("/page", StaticFiles(directory=FOLDER), name="page")
