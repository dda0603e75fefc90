"""The web page."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import os
import re
import time
from functools import cache, lru_cache
from pathlib import Path

from fastapi import APIRouter, Request, Response
from starlette.datastructures import Headers
from starlette.routing import BaseRoute, Mount
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope

from shapespace.files.poster import poster
from shapespace.page_scripts import PAGE, joined_scripts
from shapespace.service.http.caching import entity_tag
from shapespace.service.http.dependencies import AskedDependency, Model, ServiceDependency
from shapespace.service.http.responses import RangedFile, cached_response
from shapespace.service.use_cases.batch import EncodedFile

router = APIRouter(include_in_schema=False)


class TaggedFiles(StaticFiles):
    """Static files whose entity tags are digests of their content, so that replicas agree; and the joined scripts."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file or joined scripts, or 304 if the client has it already."""
        content = _scripts().get(path)
        if content is None or scope["method"] not in {"GET", "HEAD"}:
            return await super().get_response(path, scope)
        return self._answer(Response(content, media_type="text/javascript"), entity_tag(content), scope)

    def file_response(
        self, full_path: str | os.PathLike[str], stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """Return a file, or 304 if the client has it already."""
        tag = _tag(os.fspath(full_path), stat_result.st_mtime_ns)
        response = RangedFile(full_path, status_code, stat_result=stat_result)
        return self._answer(response, tag, scope)

    def _answer(self, response: Response, tag: str, scope: Scope) -> Response:
        # no-cache, so that a page never loads scripts of two versions.
        response.headers.update({"ETag": tag, "Cache-Control": "no-cache"})
        if self.is_not_modified(response.headers, Headers(scope=scope)):
            return NotModifiedResponse(response.headers)
        return response


@lru_cache(256)
def _tag(path: str, _changed: int) -> str:
    return entity_tag(Path(path).read_bytes())


@cache
def _scripts() -> dict[str, bytes]:
    return joined_scripts()


_FILES = TaggedFiles(directory=PAGE)


@router.api_route("/", methods=["GET", "HEAD"])
async def page(request: Request, service: ServiceDependency) -> Response:
    """The page; with ``?embed`` only its viewer, which the pages of some origins may show in a frame."""
    response = await _FILES.get_response("index.html", request.scope)
    framing = service.settings.embed_origins if "embed" in request.query_params else ()
    ancestors = " ".join(framing) or "'none'"
    response.headers["Content-Security-Policy"] = f"{_policy()}; frame-ancestors {ancestors}"
    return response


@router.get("/poster/{name}.svg")
async def drawing(asked: AskedDependency, model: Model) -> Response:
    """A drawing of the reference, which the page shows until its scripts have arrived."""

    async def compute() -> EncodedFile:
        began = time.perf_counter()
        content = await asyncio.to_thread(poster, model.reference)
        return EncodedFile(content, {"encode": time.perf_counter() - began})

    return await cached_response(asked, entity_tag("poster", model.digest), "image/svg+xml", "", compute)


def assets() -> BaseRoute:
    """Return the route of the page's styles and scripts."""
    return Mount("/page", _FILES, name="page")


@cache
def _policy() -> str:
    """Return the content security policy: files of this server only, and the inline scripts by their digests."""
    inline = re.findall(
        r"<script(?: type=\"\w+\")?>(.*?)</script>", (PAGE / "index.html").read_text("utf-8"), re.DOTALL
    )
    digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline)
    scripts = " ".join(["'self'", *(f"'sha256-{digest}'" for digest in digests)])
    return f"default-src 'self'; script-src {scripts}; object-src 'none'; base-uri 'none'"
