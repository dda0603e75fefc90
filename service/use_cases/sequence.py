"""Animations: their ids, and their frames as one file, as a stream of lines, or one by one."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterator
from contextlib import aclosing
from dataclasses import replace
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from shapespace.files.animated_gltf import FRAMES_PER_SECOND
from shapespace.files.archives import Buffer
from shapespace.files.colouring import Colouring
from shapespace.mesh.attributes import Topology
from shapespace.model.latent_space import CheckedCode, NotFiniteError
from shapespace.model.memory import Examples, Fade
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.workers import Call, Caller, in_parallel
from shapespace.service.refusals import RefusedError
from shapespace.service.repository.repository import ModelRepository
from shapespace.service.use_cases.animation import Animation
from shapespace.service.use_cases.batch import EncodedFile, batch, solve_all
from shapespace.service.use_cases.many_shapes import shapes, shapes_size
from shapespace.service.use_cases.one_shape import ColourOptions
from shapespace.service.use_cases.sequence_formats import Frames, encode_frames, json_line
from shapespace.service.use_cases.shape_formats import summarise, with_topology


def interpolation_id(model: ShapeModel, animation: Animation, most_frames: int) -> str:
    """Return an id that holds an animation; raises RefusedError or LatentError."""
    _require_frames(animation, most_frames)
    id = animation.to_id(model.digest, model.latents)
    try:
        model.latents.codes(animation.codes(model.latents))  # every frame must be a code
    except NotFiniteError:
        raise NotFiniteError(
            "The path leads so far away that the numbers overflow. Send smaller keyframes, times, start or stop; "
            "they must be finite."
        ) from None
    return id


def find_interpolation(repository: ModelRepository, id: str, most_frames: int) -> tuple[Animation, ShapeModel]:
    """Return the animation of an id, and its model; raises RefusedError."""
    animation, digest = Animation.from_id(id)
    _require_frames(animation, most_frames)
    model = repository.by_digest(digest)
    if model is None:
        raise RefusedError(
            "unknown-interpolation",
            "The model of this interpolation is not served here any more. POST the keyframes to the "
            "interpolations of a model that /v1/models lists.",
        )
    return animation, model


def frame_code(model: ShapeModel, animation: Animation, k: int) -> CheckedCode:
    """Return the code of one frame; raises RefusedError, unknown-frame."""
    if not 0 <= k < animation.frame_count:
        raise RefusedError("unknown-frame", f"There is no frame {k}. Choose one from 0 to {animation.frame_count - 1}.")
    return model.latents.code(animation.codes(model.latents, slice(k, k + 1))[0])


def frame_memory(model: ShapeModel, animation: Animation, k: int) -> Examples:
    """Return the memory of training shapes for one frame. A keyframe has the memory of its code alone."""
    memory = animation.memory(model.latents, slice(k, k + 1))
    alone = not model.decoder.remembers or (isinstance(memory, Fade) and memory.share[0] in {0, 1})
    return True if alone else memory


async def sequence_file(
    caller: Caller,
    model: ShapeModel,
    animation: Animation,
    quality: Quality,
    format: str,
    topology: Topology = Topology.ORIGINAL,
    fps: float = FRAMES_PER_SECOND,
    colour_by: ColourOptions | None = None,
) -> EncodedFile:
    """Return all frames as one file in a format of SEQUENCE_FORMATS; raises RefusedError."""
    codes, inside = model.latents.codes(animation.codes(model.latents))
    memory = animation.memory(model.latents)
    number, mesh = len(codes), animation.mesh
    if colour_by and colour_by.against is not None:  # computed as one more shape, the last
        code, within = colour_by.against
        codes, inside = np.concatenate([codes, code[None]]), np.append(inside, within)
        memory = memory.followed_by(code) if isinstance(memory, Fade) else memory
    # Colours take as much memory as positions.
    caller = replace(caller, long=True)
    async with batch(caller, shapes_size(model, len(codes) * (2 if colour_by else 1), mesh)) as work:
        # A frame has the same bytes alone and in the whole animation.
        found = await shapes(work, model, codes, inside, mesh, quality, apart=True, examples=memory)
        vertices, whole = found.vertices[:number], model.mesh(mesh)
        surface = with_topology(model.decoder.surface(mesh), topology)

        colourings: list[Colouring] = []

        def encode() -> tuple[Iterator[Buffer], dict[str, Any]]:
            if colour_by:
                against = found.vertices[-1].astype(np.float64)
                if colour_by.against is None:
                    against = model.decoder.reference_shape(mesh).vertices
                colourings.extend(Colouring.of_frames(colour_by.quantity, vertices, against, whole.connectivity))
            each = found.diagnostics[:number]
            shown = vertices, each, whole.faces, animation.positions, codes[:number], surface, fps, colourings
            frames = Frames(*shown, animation.name or "animation")
            return encode_frames(frames, format)

        written = await work.write(encode, found.seconds, summarise(found.diagnostics[:number]))
        return replace(written, legend=colourings[0].legend) if colourings else written


async def sequence_lines(
    caller: Caller, model: ShapeModel, animation: Animation, quality: Quality
) -> AsyncGenerator[bytes, None]:
    """Yield each frame as a line of JSON as soon as it is ready; raises RefusedError and as ``Call.run``."""
    codes, inside = model.latents.codes(animation.codes(model.latents))
    faces, memory = model.mesh(animation.mesh).faces, animation.memory(model.latents)

    def lines(some: slice, call: Call) -> tuple[list[bytes], Exception | None]:
        """Return the lines of some frames; with an error only the lines before it."""
        found: list[bytes] = []
        own = memory[some] if isinstance(memory, Fade) else memory
        solved = solve_all(call, model, animation.mesh, quality, (codes[some], inside[some]), own)
        times = animation.positions[some].tolist()
        try:
            for k, t, shape in zip(count(some.start), times, solved, strict=False):
                found.append(json_line(k, t, shape, None if k else faces))
        except Exception as error:
            return found, error
        return found, None

    # Each run of frames has its own deadline, because a stream may take as long as its reader takes.
    caller = replace(caller, long=True)
    with caller.stream():
        # The first frame is computed alone, so that nobody waits for the others.
        first = slice(0, 1)
        runs = model.decoder.frames(codes, quality, memory)
        rest = (slice(max(run.start, 1), run.stop) for run in runs if run.stop > 1)
        ready, error = await caller.run(partial(lines, first))
        for line in ready:
            yield line
        if error:
            raise error
        async with aclosing(in_parallel(caller, lines, rest)) as batches:
            async for ready, error in batches:
                for line in ready:
                    yield line
                if error:
                    raise error


def _require_frames(animation: Animation, most: int) -> None:
    if animation.frames > most:
        raise RefusedError(
            "too-many-frames",
            f"frames is {animation.frames}; the limit is {most}. Ask for fewer frames, or for parts of the path with "
            "start and stop.",
        )
