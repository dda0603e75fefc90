"""Lengths and angles (NRIC) as the networks predict them, before any reconstruction."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.files.archives import Buffer
from shapespace.model.latent_space import Bounds, Codes
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.workers import Call, Caller, Workers
from shapespace.service.use_cases.batch import Batch, EncodedFile, TooManyCodesError, batch
from shapespace.service.use_cases.shape_formats import float32, json_pieces

#: Most bytes of the predictions in one answer. Networks with convolutions need more memory than their outputs.
MOST_BYTES = 2**25


@dataclass(frozen=True)
class Predictions:
    """Lengths and angles of several codes, in the units of the training meshes and in radians.

    Attributes:
        nric: (n, 2E) float32.
        factors: (n, J, 2E) float32, if requested.
    """

    nric: NDArray[np.float32]
    factors: NDArray[np.float32] | None


async def nric_file(
    workers: Workers,
    caller: Caller,
    model: ShapeModel,
    latents: Sequence[Sequence[float]],
    bounds: Bounds,
    *,
    factors: bool,
) -> EncodedFile:
    """Return lengths and angles of codes as JSON, on request also the lengths and angles of each factor.

    Raises:
        LatentError: a code is invalid.
        TooManyCodesError, BusyError: the predictions exceed the limit of one answer, or of all together.
        DeadlineError, DisconnectedError, EndingError: the call ended before the file was ready.
    """
    codes, _ = model.latents.codes(latents, bounds)
    async with batch(workers, caller, nric_size(model, len(codes), factors=factors)) as work:
        began = time.perf_counter()
        found = await predictions(work, model, codes, factors=factors)
        seconds = {"network": time.perf_counter() - began}

        def encode() -> tuple[Iterator[Buffer], dict[str, Any]]:
            lengths, angles = np.split(found.nric, 2, axis=1)
            lists: dict[str, Iterable[Any]] = {"lengths": map(float32, lengths), "angles": map(float32, angles)}
            if found.factors is not None:
                lists["factors"] = found.factors
            return json_pieces(lists), {}

        return await work.write(encode, seconds)


def nric_size(model: ShapeModel, count: int, *, factors: bool = False) -> int:
    """Return the size of predictions in bytes; raises TooManyCodesError above the limit of one answer."""
    size = 8 * model.manifest.edges * (1 + (len(model.manifest.factors) if factors else 0))
    if count * size > MOST_BYTES:
        raise TooManyCodesError(f"{count} codes are too many for one answer. Ask for {MOST_BYTES // size} at most.")
    return count * size


async def predictions(work: Batch, model: ShapeModel, codes: Codes, *, factors: bool = False) -> Predictions:
    """Return the predictions of the networks for codes (n, m); raises as ``Batch.map``."""
    n, wide = len(codes), 2 * model.manifest.edges
    found = np.empty((n, wide), np.float32)
    parts = np.empty((n, len(model.manifest.factors), wide), np.float32) if factors else None

    def predict(item: tuple[int, Codes], _: Call) -> None:
        k, code = item
        found[k], of_factors = model.decoder.lengths_and_angles(code)
        if parts is not None:
            parts[k] = of_factors

    await work.map(predict, enumerate(codes))
    return Predictions(found, parts)
