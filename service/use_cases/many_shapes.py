"""Many shapes in one answer: positions, true discrete exponentials, lengths and angles, and a model as blend shapes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.files.archives import Buffer
from shapespace.files.npz import npz_pieces
from shapespace.files.reading import OCTET_STREAM
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.blend_shapes import blend_shapes, require_ends
from shapespace.model.decoder import MeshChoice
from shapespace.model.exact_shapes import ExactShape, exact_shape, require_tangent_space
from shapespace.model.latent_space import Bounds, Codes
from shapespace.model.memory import Examples
from shapespace.model.shape import Diagnostics, Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.workers import Call, Caller
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.batch import (
    Batch,
    EncodedFile,
    Timings,
    batch,
    solve,
    solve_all,
    total_seconds,
)
from shapespace.service.use_cases.one_shape import place_vertices
from shapespace.service.use_cases.shape_formats import (
    diagnostics_arrays,
    exponential_arrays,
    exponential_lists,
    float32,
    json_pieces,
    summarise,
)

#: Most vertices of all shapes of one answer together: 48 MiB of positions.
MOST_VERTICES = 2**22
#: Most bytes of the predictions in one answer. Networks with convolutions need more memory than their outputs.
MOST_NRIC_BYTES = 2**25
#: Most codes of an inference that counts as a short call.
SHORT_INFERENCE = 16
#: Three coordinates in float32.
BYTES_PER_VERTEX = 12
#: Media types of the formats of many shapes, by name; the first is the default.
VERTICES_TYPES = {"json": "application/json", "npz": OCTET_STREAM}


@dataclass(frozen=True)
class ShapeBatch:
    """Several shapes: vertices (n, V, 3), in the units of the training meshes, and the total time by stage."""

    vertices: NDArray[np.float32]
    diagnostics: list[Diagnostics]
    seconds: Timings


async def vertices_file(
    caller: Caller,
    model: ShapeModel,
    latents: Sequence[Sequence[float]],
    bounds: Bounds,
    mesh: MeshChoice,
    format: str,
    *,
    quality: Quality = Quality.AUTO,
    exponentials: bool = False,
    place: Placement | None = None,
    faces: bool = True,
) -> EncodedFile:
    """Return positions and diagnostics of shapes, in a format of VERTICES_TYPES.

    With the true discrete exponentials if asked for, elsewhere by ``place``, and in NPZ with the ``faces`` of the mesh.

    Raises:
        NoTangentSpaceError: the model has no exponentials.
        LatentError: a code is invalid.
        RefusedError, too-many-codes: the shapes exceed the limit of one answer.
    """
    if exponentials:
        require_tangent_space(model.decoder)
    codes, inside = model.latents.codes(latents, bounds)
    caller = replace(caller, long=exponentials)
    async with batch(caller, shapes_size(model, (2 if exponentials else 1) * len(codes), mesh)) as work:
        found = await shapes(work, model, codes, inside, mesh, quality)
        true = await _exponentials(work, model, codes, found, mesh) if exponentials else None
        if place:
            found = replace(found, vertices=place_vertices(found.vertices, place).astype(np.float32))
            true = [_place_exact(shape, place) for shape in true] if true else None

        def encode() -> tuple[Iterator[Buffer], dict[str, Any]]:
            if format == "json":
                diagnostics = map(asdict, found.diagnostics)
                lists: dict[str, Iterable[Any]] = {"vertices": found.vertices, "diagnostics": diagnostics}
                return json_pieces(lists | (exponential_lists(true) if true else {})), {}
            arrays = diagnostics_arrays(found.diagnostics)
            arrays |= exponential_arrays(true, found.vertices.shape[1]) if true else {}
            arrays |= {"faces": model.mesh(mesh).faces} if faces else {}
            return npz_pieces(vertices=found.vertices, latents=codes, **arrays), {}

        return await work.write(encode, found.seconds, summarise(found.diagnostics))


def _place_exact(exact: ExactShape, place: Placement) -> ExactShape:
    if exact.vertices is None or exact.mean is None or exact.max is None:
        return exact
    vertices = place_vertices(exact.vertices, place).astype(np.float32)
    return replace(exact, vertices=vertices, mean=place.scale * exact.mean, max=place.scale * exact.max)


#: Encodes the outputs of ``infer``, by name, as the pieces of a file and facts about it.
WriteOutputs = Callable[[Mapping[str, NDArray[np.float32]]], tuple[Iterator[Buffer], Mapping[str, Any]]]


async def infer(
    caller: Caller,
    model: ShapeModel,
    latents: NDArray[np.floating],
    bounds: Bounds,
    mesh: MeshChoice,
    quality: Quality,
    outputs: Sequence[str],
    write: WriteOutputs,
) -> EncodedFile:
    """Return the outputs for codes (n, m): ``nric`` (n, 2E), ``vertices`` (n, V, 3); raises as ``vertices_file``."""
    codes, inside = model.latents.codes(latents, bounds)
    size = sum(
        shapes_size(model, len(codes), mesh) if name == "vertices" else nric_size(model, len(codes)) for name in outputs
    )
    if size > BYTES_PER_VERTEX * MOST_VERTICES:
        raise RefusedError(
            "too-many-codes",
            f"{len(codes)} codes are too many for both outputs. Ask for one output, or send fewer codes.",
        )
    caller = replace(caller, long=len(codes) > SHORT_INFERENCE)
    async with batch(caller, size) as work:
        arrays: dict[str, NDArray[np.float32]] = {}
        found: ShapeBatch | None = None
        for name in outputs:
            if name == "vertices":
                found = await shapes(work, model, codes, inside, mesh, quality)
                arrays[name] = found.vertices
            else:
                arrays[name] = (await predictions(work, model, codes))[0]
        seconds, diagnostics = (found.seconds, summarise(found.diagnostics)) if found else ({}, None)
        return await work.write(lambda: write(arrays), seconds, diagnostics)


def most_inferred(model: ShapeModel) -> int:
    """Return the largest number of codes for which ``infer`` answers both outputs, with the fine mesh."""
    vertices, nric = (3 * len(model.mesh(MeshChoice.FINE).vertices), 2 * model.manifest.edges)
    together = BYTES_PER_VERTEX * MOST_VERTICES // (4 * (vertices + nric))
    return min(together, 3 * MOST_VERTICES // vertices, MOST_NRIC_BYTES // (4 * nric))


def shapes_size(model: ShapeModel, count: int, mesh: MeshChoice) -> int:
    """Return the size of several shapes in bytes; raises RefusedError above the limit of one answer."""
    vertices = len(model.mesh(mesh).vertices)
    if count * vertices > MOST_VERTICES:
        raise RefusedError(
            "too-many-codes",
            f"{count} shapes of {vertices} vertices are too many for one answer. Ask for {MOST_VERTICES // vertices} "
            "at most, for the coarse mesh, or for an animation's frames as JSON lines or one by one.",
        )
    return BYTES_PER_VERTEX * count * vertices


async def shapes(
    work: Batch,
    model: ShapeModel,
    codes: Codes,
    inside: NDArray[np.bool_],
    mesh: MeshChoice,
    quality: Quality,
    *,
    apart: bool = False,
    examples: Examples = True,
) -> ShapeBatch:
    """Return the shapes of codes (n, m), computed in parallel; raises as ``Batch.map``.

    Networks run for several codes at once, which changes the last digits. Codes ``apart``, as the frames of an
    animation, have the same bytes as alone. ``examples`` is the memory of training shapes.
    """
    vertices = np.empty((len(codes), *model.mesh(mesh).vertices.shape), np.float32)

    def find(some: slice, call: Call) -> list[tuple[Diagnostics, Timings]]:
        found = []
        own = examples if isinstance(examples, bool) else examples[some]
        solved = solve_all(call, model, mesh, quality, (codes[some], inside[some]), own)
        for k, shape in enumerate(solved, some.start):
            vertices[k] = shape.vertices
            found.append((shape.diagnostics, shape.seconds))
        return found

    batches = model.decoder.frames(codes, quality, examples) if apart else model.decoder.batches(codes, quality)
    found = [*chain(*await work.map(find, batches))]
    return ShapeBatch(
        vertices, [diagnostics for diagnostics, _ in found], total_seconds(seconds for _, seconds in found)
    )


async def _exponentials(
    work: Batch, model: ShapeModel, codes: Codes, found: ShapeBatch, mesh: MeshChoice
) -> list[ExactShape]:
    """Return the discrete exponentials of codes (n, m), and the distances of the networks' shapes from them."""

    def one(item: tuple[Codes, NDArray[np.float32]], call: Call) -> ExactShape:
        return exact_shape(model.decoder, *item, mesh, call)

    return await work.map(one, zip(codes, found.vertices, strict=True))


async def blend_shapes_file(caller: Caller, model: ShapeModel, mesh: MeshChoice) -> EncodedFile:
    """Return a GLB with a morph target for each bound of each coordinate.

    Raises:
        PeriodicError: a coordinate is periodic, so that it has no bounds.
        RefusedError, too-many-codes: all targets together have more vertices than one answer may hold.
        NotFiniteError, ModelFailedError: the model has no shape at a bound.
    """
    require_ends(model.decoder)
    size = shapes_size(model, 2 * model.latents.dimension + 1, mesh)

    def make(call: Call) -> EncodedFile:
        began = time.perf_counter()
        found = blend_shapes(model.decoder, mesh, lambda code: solve(call, model, mesh, Quality.FULL, (code, True)))
        solved = time.perf_counter()
        content = found.glb()
        return EncodedFile(content, {"reconstruct": solved - began, "encode": time.perf_counter() - solved})

    with caller.holding(size):
        async with replace(caller, long=True).admit() as call:
            return await call.run(make)


async def nric_file(
    caller: Caller,
    model: ShapeModel,
    latents: Sequence[Sequence[float]],
    bounds: Bounds,
    *,
    factors: bool,
) -> EncodedFile:
    """Return lengths and angles as the networks predict them, as JSON, on request also those of each factor.

    Raises LatentError, and RefusedError if they exceed the limit of one answer.
    """
    codes, _ = model.latents.codes(latents, bounds)
    async with batch(caller, nric_size(model, len(codes), factors=factors)) as work:
        began = time.perf_counter()
        found, parts = await predictions(work, model, codes, factors=factors)
        seconds = {"network": time.perf_counter() - began}

        def encode() -> tuple[Iterator[Buffer], dict[str, Any]]:
            lengths, angles = np.split(found, 2, axis=1)
            lists: dict[str, Iterable[Any]] = {"lengths": map(float32, lengths), "angles": map(float32, angles)}
            if parts is not None:
                lists["factors"] = parts
            return json_pieces(lists), {}

        return await work.write(encode, seconds)


def nric_size(model: ShapeModel, count: int, *, factors: bool = False) -> int:
    """Return the size of predictions in bytes; raises RefusedError above the limit of one answer."""
    size = 8 * model.manifest.edges * (1 + (len(model.manifest.factors) if factors else 0))
    if count * size > MOST_NRIC_BYTES:
        raise RefusedError(
            "too-many-codes", f"{count} codes are too many for one answer. Ask for {MOST_NRIC_BYTES // size} at most."
        )
    return count * size


async def predictions(
    work: Batch, model: ShapeModel, codes: Codes, *, factors: bool = False
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return the predictions (n, 2E) of the networks for codes (n, m), and those of the factors (n, J, 2E) if asked."""
    n, wide = len(codes), 2 * model.manifest.edges
    found = np.empty((n, wide), np.float32)
    parts = np.empty((n, len(model.manifest.factors), wide), np.float32) if factors else None

    def predict(item: tuple[int, Codes], _: Call) -> None:
        k, code = item
        found[k], of_factors = model.decoder.lengths_and_angles(code)
        if parts is not None:
            parts[k] = of_factors

    await work.map(predict, enumerate(codes))
    return found, parts
