"""Shapes as HTTP answers: entity tags, diagnostics and timings in headers, problems in the description."""

from __future__ import annotations

import hashlib
import time
from collections.abc import AsyncGenerator, Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, aclosing
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from numpy.typing import NDArray
from starlette.types import Receive, Scope, Send

from shapespace import __version__
from shapespace.files.archives import Buffer
from shapespace.files.colouring import Colouring
from shapespace.model.decoder import Diagnostics, MeshChoice, Shape
from shapespace.model.latent_space import CheckedCode, Codes
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.dependencies import Service
from shapespace.service.http.messages.color_query import Comparison
from shapespace.service.http.messages.schemas import MeshAnswer
from shapespace.service.http.problems import KINDS, MEDIA_TYPE, ProblemError
from shapespace.service.http.recent import Answer
from shapespace.service.limits.workers import Call, Workers
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS, dump_json
from shapespace.solve.deadline import Deadline
from shapespace.solve.status import Status

Timings = dict[str, float]
#: Vertices of all shapes of one answer together: 48 MiB of positions.
MOST_VERTICES = 2**22
#: Bytes of what an answer is made from, up to which it is made whole.
WHOLE = 2**22
#: Of an answer that was there already.
_NO_TIME = {"network": 0.0, "reconstruct": 0.0, "encode": 0.0}
S = TypeVar("S")
T = TypeVar("T")
_HEADERS = {
    name: {"description": description, "schema": {"type": "string"}}
    for name, description in {
        "ETag": "Strong; the same from every replica. Sent back as `If-None-Match` it saves the work.",
        "Shape-Diagnostics": (
            "JSON: `status`, `iterations`, `residual`, `flipped_faces`, `integrability`, `plausibility`, "
            "`inside_bounds`, `model`."
        ),
        "Server-Timing": "Milliseconds by stage: `network`, `reconstruct`, `encode`.",
    }.items()
}


def entity_tag(*parts: str | bytes) -> str:
    """A strong entity tag of all that the bytes of an answer depend on; the product's version is added."""
    digest = hashlib.sha256()
    for part in (__version__, *parts):
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "big") + data)
    return f'"{digest.hexdigest()[:32]}"'


def cache_headers(tag: str) -> dict[str, str]:
    """Headers that let a client keep an answer and ask whether it still holds."""
    return {"ETag": tag, "Vary": "Accept", "Cache-Control": "no-cache"}


def not_modified(request: Request, tag: str) -> Response | None:
    """304 where the client has the answer already."""
    # Not where it is "*": whether there is a shape at all is known only once it has been found.
    known = {part.strip().removeprefix("W/") for part in request.headers.get("if-none-match", "").split(",")}
    return Response(status_code=304, headers=cache_headers(tag)) if tag in known else None


def server_timing(seconds: Timings) -> str:
    """The ``Server-Timing`` header, in milliseconds."""
    return ", ".join(f"{stage};dur={1e3 * duration:.3f}" for stage, duration in seconds.items())


def file_headers(diagnostics: Mapping[str, Any], filename: str) -> dict[str, str]:
    """Headers of an answer that is a file."""
    return {
        "Shape-Diagnostics": dump_json(diagnostics).decode(),
        "Content-Disposition": f'inline; filename="{filename}"',
    }


def solve(workers: Workers, model: ShapeModel, mesh: MeshChoice, code: CheckedCode, deadline: Deadline) -> Shape:
    """A code to its shape; raises DeadlineError."""
    shape = model.shape(*code, mesh, deadline)
    if shape.diagnostics.status is Status.DEADLINE:
        raise workers.late()
    return shape


async def shape_response(
    service: Service,
    request: Request,
    model: ShapeModel,
    code: CheckedCode | None,
    mesh: MeshChoice,
    format: str,
    comparison: Comparison | None = None,
) -> Response:
    """One shape as a file; without a code the reference."""
    tag = entity_tag(
        "shape",
        model.digest,
        b"" if code is None else code[0].tobytes(),
        mesh,
        format,
        *(comparison.key if comparison else ()),
    )
    if unchanged := not_modified(request, tag):
        return unchanged

    def find(code: CheckedCode | None, deadline: Deadline) -> Shape:
        return model.reference_shape(mesh) if code is None else solve(service.workers, model, mesh, code, deadline)

    def make(deadline: Deadline) -> tuple[bytes, dict[str, str]]:
        found = [find(code, deadline)]
        began, colouring, legend = time.perf_counter(), None, {}
        if comparison:
            found.append(find(comparison.code, deadline))
            began = time.perf_counter()
            vertices, against = (shape.vertices for shape in found)
            colouring = Colouring.between(comparison.quantity, vertices, against, model.mesh(mesh).connectivity)
            legend = {"Shape-Color": dump_json(colouring.legend).decode()}
        content = SHAPE_FORMATS[format].encode(found[0].vertices, model.mesh(mesh).faces, colouring)
        seconds = {**total_seconds([shape.seconds for shape in found]), "encode": time.perf_counter() - began}
        filename = f"{model.manifest.name}.{format}"
        headers = file_headers(asdict(found[0].diagnostics), filename) | {"Server-Timing": server_timing(seconds)}
        return content, headers | legend

    if answer := service.recent.get(tag):
        content, headers = answer.content, {**answer.headers, "Server-Timing": server_timing(_NO_TIME)}
    else:
        async with service.workers.admit(request) as deadline:
            content, headers = await service.workers.run(make, deadline)
        service.recent.put(tag, Answer(content, headers))
    return Response(content, headers=cache_headers(tag) | headers, media_type=SHAPE_FORMATS[format].media_type)


@dataclass(frozen=True)
class Shapes:
    """Several shapes as they leave.

    Attributes:
        vertices: (n, V, 3) float32, in the units of the training meshes.
        diagnostics: how well each was found.
        seconds: time of all of them by stage.
    """

    vertices: NDArray[np.float32]
    diagnostics: list[Diagnostics]
    seconds: Timings


def size_of(model: ShapeModel, count: int, mesh: MeshChoice) -> int:
    """Bytes of that many shapes; raises ProblemError, too-many-codes, where they are more than one request may hold."""
    vertices = len(model.mesh(mesh).vertices)
    if count * vertices > MOST_VERTICES:
        raise ProblemError(
            "too-many-codes",
            f"{count} shapes of {vertices} vertices are too many for one answer. Ask for {MOST_VERTICES // vertices} "
            "at most, for the coarse mesh, or for an animation's frames as JSON lines or one by one.",
        )
    return 12 * count * vertices


async def shapes(
    service: Service, model: ShapeModel, codes: Codes, inside: Any, mesh: MeshChoice, call: Call
) -> Shapes:
    """Shapes of codes (n, m), side by side; raises as ``Workers.run``."""
    vertices = np.empty((len(codes), *model.mesh(mesh).vertices.shape), np.float32)

    def find(item: tuple[int, CheckedCode], call: Call) -> tuple[Diagnostics, Timings]:
        k, code = item
        shape = solve(service.workers, model, mesh, code, call)
        vertices[k] = shape.vertices
        return shape.diagnostics, shape.seconds

    found = await gather(service, find, enumerate(zip(codes, map(bool, inside), strict=True)), call)
    return Shapes(vertices, [diagnostics for diagnostics, _ in found], total_seconds([s for _, s in found]))


@dataclass(frozen=True)
class Predictions:
    """Lengths and angles of several codes as they leave: in the units of the training meshes, angles in radians.

    Attributes:
        nric: (n, 2E) float32.
        factors: (n, J, 2E) float32, where they are wanted.
    """

    nric: NDArray[np.float32]
    factors: NDArray[np.float32] | None


def nric_size_of(model: ShapeModel, count: int, *, factors: bool = False) -> int:
    """Bytes of predictions for that many codes; raises ProblemError as ``size_of``."""
    size = 8 * model.manifest.edges * (1 + (len(model.manifest.factors) if factors else 0))
    # Networks with convolutions need more room beside their answers than shapes do.
    if count * size > 8 * MOST_VERTICES:
        most = 8 * MOST_VERTICES // size
        raise ProblemError("too-many-codes", f"{count} codes are too many for one answer. Ask for {most} at most.")
    return count * size


async def predictions(
    service: Service, model: ShapeModel, codes: Codes, call: Call, *, factors: bool = False
) -> Predictions:
    """What the networks say to codes (n, m), side by side; raises as ``Workers.run``."""
    n, wide = len(codes), 2 * model.manifest.edges
    found = np.empty((n, wide), np.float32)
    parts = np.empty((n, len(model.manifest.factors), wide), np.float32) if factors else None

    def predict(item: tuple[int, Codes], _: Call) -> None:
        k, code = item
        z = model.lengths_and_angles(code)
        found[k] = np.concatenate([z.lengths, z.angles])
        if parts is not None:
            parts[k] = z.factors

    await gather(service, predict, enumerate(codes), call)
    return Predictions(found, parts)


async def gather(service: Service, work: Callable[[S, Call], T], items: Iterable[S], call: Call) -> list[T]:
    """Results of work on every item, side by side; raises as ``Workers.run``."""
    async with aclosing(service.workers.map(work, items, call)) as results:
        return [result async for result in results]


def total_seconds(seconds: list[Timings]) -> Timings:
    """Time of several shapes by stage."""
    return {stage: sum(each[stage] for each in seconds) for stage in ("network", "reconstruct")}


async def in_pieces(
    service: Service,
    call: Call,
    pieces: Iterator[Buffer],
    size: int,
    held: ExitStack,
    headers: Mapping[str, str],
    seconds: Timings,
    media_type: str,
) -> Response:
    """An answer from its pieces: whole where it is small, otherwise as fast as it is read.

    Args:
        service: the running one.
        call: of the request.
        pieces: of the body.
        size: bytes of what they are made from.
        held: what the answer takes until it is over.
        headers: of the answer.
        seconds: time so far, by stage; to the first piece counts as encoding.
        media_type: of the answer.
    """
    began = time.perf_counter()
    make = partial(next, pieces) if size > WHOLE else partial(b"".join, pieces)
    start = await service.workers.run(lambda _: make(), call)
    headers = {**headers, "Server-Timing": server_timing({**seconds, "encode": time.perf_counter() - began})}
    if size <= WHOLE:
        return Response(start, headers=headers, media_type=media_type)
    return PiecewiseResponse(chain([start], pieces), service.workers, held.pop_all(), headers, media_type)


class PiecewiseResponse(StreamingResponse):
    """An answer that is made piece by piece, in a thread, as fast as it is read.

    Args:
        pieces: of the body.
        workers: whose threads make them.
        held: what the answer takes until it is over.
        headers: of the answer.
        media_type: of the answer.
    """

    def __init__(
        self, pieces: Iterator[Buffer], workers: Workers, held: ExitStack, headers: Mapping[str, str], media_type: str
    ) -> None:
        super().__init__(_made(pieces, workers), headers=dict(headers), media_type=media_type)
        self._held = held

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        with self._held:
            await super().__call__(scope, receive, send)


async def _made(pieces: Iterator[Buffer], workers: Workers) -> AsyncGenerator[bytes | memoryview, None]:
    while (piece := await workers.piece(lambda _: next(pieces, None), None)) is not None:
        yield piece if isinstance(piece, bytes) else memoryview(piece)


def binary(media_types: Mapping[str, str], description: str, *, cached: bool = True) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's description of an answer in one of several binary formats, with an entity tag where ``cached``."""
    schema = {"schema": {"type": "string", "format": "binary"}}
    others = {media_type: schema for media_type in media_types.values() if media_type != "application/json"}
    headers = {name: header for name, header in _HEADERS.items() if cached or name != "ETag"}
    answers: dict[int | str, dict[str, Any]] = {
        200: {"description": description, "content": others, "headers": headers}
    }
    if cached:
        answers[304] = {"description": "The client has this answer already, by `If-None-Match`."}
    return answers


def mesh_answers(description: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's description of a mesh in one of its formats."""
    answers = binary({name: format.media_type for name, format in SHAPE_FORMATS.items()}, description)
    answers[200]["model"] = MeshAnswer
    answers[200]["headers"] |= {
        "Shape-Color": {
            "description": "JSON, with `color`: `quantity`, `range` of the legend, `map`.",
            "schema": {"type": "string"},
        }
    }
    return answers


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's description of the problems that a call may answer."""
    reference = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        status: {
            "description": "; ".join(
                f"{kind.title} (`{name}`)" for name, kind in KINDS.items() if kind.status == status
            ),
            "content": reference,
        }
        for status in statuses
    }
