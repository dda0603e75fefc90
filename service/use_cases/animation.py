"""Paths through latent space, their frames, and the ids that hold a whole animation."""

from __future__ import annotations

import base64
import binascii
import hashlib
import zlib
from itertools import pairwise
from typing import Annotated

import numpy as np
import orjson
from pydantic import ConfigDict, Field, ValidationError, field_validator, model_validator

from shapespace.arrays import FloatArray
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import LatentSpace
from shapespace.model.memory import FRAMES_PER_RUN, Examples, Fade
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.fields import Body, Number, Whole
from shapespace.service.use_cases.shape_formats import holds_more_values

# An id is base64 of a checksum and compressed JSON. With these limits, reading it takes a few milliseconds at most.

#: Most characters of an id; most proxies allow a URL of at most 16 KiB.
ID_LENGTH = 15_000
#: Most bytes that an id may unpack to, and most JSON values in them.
ID_BYTES, ID_VALUES = 2**16, 2**13
#: Bytes of the checksum, the first of SHA-256 of the JSON, and hexadecimal digits of the model's digest.
CHECKSUM_BYTES, DIGEST_DIGITS = 9, 32


class Animation(Body):
    """A piecewise linear path through latent codes, sampled at equal steps.

    Frame k of n lies at ``t = start + k (stop − start) / (n − 1)``; t is 0 at the first keyframe and 1 at the last.
    Outside [0, 1], the first or the last segment continues in a straight line. Periodic coordinates take the shorter
    arc.
    """

    model_config = ConfigDict(
        frozen=True, json_schema_extra={"examples": [{"keyframes": [[0, 0, 0, 0], [1, 2, 3, 4]], "frames": 30}]}
    )

    keyframes: Annotated[
        list[Annotated[list[Number], Field(fail_fast=True, json_schema_extra={"minItems": 1})]], Field(fail_fast=True)
    ] = Field(min_length=2, description="At least two latent codes.")
    times: Annotated[list[Number], Field(fail_fast=True)] | None = Field(
        None,
        description="Increasing times of the keyframes in any unit; equal distances by default. With `loop`, the "
        "last segment, back to the first keyframe, takes the mean time of the others.",
    )
    frames: Whole = Field(
        30,
        ge=2,
        description="Number n of frames, including both ends; `loop` leaves out the last frame. "
        "At most `SHAPESPACE_MAX_FRAMES`, 600 by default.",
    )
    start: Number = Field(0.0, description="t of the first frame; below 0 extrapolates.")
    stop: Number = Field(1.0, description="t of the last frame; above 1 extrapolates.")
    loop: bool = Field(
        False,
        strict=True,
        description="Append the first keyframe and drop the last frame, so that the animation repeats without a jump.",
    )
    mesh: MeshChoice = Field(MeshChoice.FINE, description="The mesh of the frames, fine or coarse.")
    examples: bool = Field(
        True,
        strict=True,
        description="Whether keyframes reproduce training shapes exactly. Between two keyframes, their corrections "
        "fade in proportion to the position, so the speed stays even. `false` leaves out stored training shapes.",
    )
    name: str | None = Field(
        None, min_length=1, max_length=60, description="Name of the animation in GLB files, `animation` by default."
    )

    @field_validator("times")
    @classmethod
    def _increasing(cls, times: list[float] | None) -> list[float] | None:
        if times is not None and not all(a < b for a, b in pairwise(times)):
            raise ValueError("times must increase from each keyframe to the next; sort them and drop repetitions")
        return times

    @model_validator(mode="after")
    def _one_time_each(self) -> Animation:
        if self.times is not None and len(self.times) != len(self.keyframes):
            raise ValueError(
                f"times has {len(self.times)} entries for {len(self.keyframes)} keyframes; send as many, or none"
            )
        return self

    @property
    def frame_count(self) -> int:
        """Number of answered frames: ``frames``, or one less with ``loop``."""
        return self.frames - self.loop

    @property
    def positions(self) -> FloatArray:
        """Position t of each answered frame, (n,)."""
        return (self.start + np.arange(self.frames) * (self.stop - self.start) / (self.frames - 1))[: self.frame_count]

    def codes(self, latents: LatentSpace, which: slice = slice(None)) -> list[list[float]]:
        """Return the codes (n, m) of all or some frames, periodic coordinates not reduced; raises LatentError."""
        with np.errstate(all="ignore"):  # a client's times may overflow, which the check of codes finds
            path = self._segments(latents, which)
            share = path.share[:, None]
            # This form gives both keyframes exactly, at share 0 and 1.
            codes: list[list[float]] = ((1 - share) * path.first + share * path.last).tolist()
        return codes

    def memory(self, latents: LatentSpace, which: slice = slice(None)) -> Examples:
        """Return the memory of training shapes for all or some frames; raises LatentError."""
        if not self.examples:
            return False
        path = self._segments(latents, which)
        first, last = (latents.codes(ends.tolist())[0] for ends in (path.first, path.last))
        return Fade(first, last, path.share, path.row)

    def _segments(self, latents: LatentSpace, which: slice) -> Fade:
        keyframes = latents.codes(self.keyframes)[0].astype(np.float64)
        knots = np.arange(len(keyframes), dtype=np.float64) if self.times is None else np.array(self.times)
        if self.loop:
            keyframes = np.concatenate([keyframes, keyframes[:1]])
            knots = np.append(knots, knots[-1] + (knots[-1] - knots[0]) / (len(knots) - 1))
        keyframes = latents.unroll(keyframes)
        t = knots[0] + self.positions[which] * (knots[-1] - knots[0])
        segment = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
        share = (t - knots[segment]) / (knots[segment + 1] - knots[segment])
        row = np.arange(self.frame_count)[which] % FRAMES_PER_RUN
        return Fade(keyframes[segment], keyframes[segment + 1], share, row)

    def to_id(self, model_digest: str, latents: LatentSpace) -> str:
        """Return an id that holds the whole animation, so that any replica can answer it at any time.

        The id is of the animation's canonical form: equal animations of a model have equal ids. Raises LatentError, or
        RefusedError, path-too-long.
        """
        too_long = RefusedError(
            "path-too-long",
            f"{len(self.keyframes)} keyframes of {latents.dimension} numbers don't fit into an "
            "interpolation's address. Send fewer keyframes, or the parts of the path one by one.",
        )
        if len(self.keyframes) + sum(map(len, self.keyframes)) > ID_VALUES:
            raise too_long  # before computing anything from them
        content = self.model_dump(mode="json", exclude_none=True)
        if self.examples:  # ids of version 0.2 stay the same
            del content["examples"]
        content["keyframes"] = latents.codes(self.keyframes)[0]
        content["model"] = model_digest[:DIGEST_DIGITS]
        payload = orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_SORT_KEYS)
        packed = _checksum(payload) + zlib.compress(payload, 9)
        name = base64.urlsafe_b64encode(packed).rstrip(b"=").decode()
        if len(name) > ID_LENGTH or len(payload) > ID_BYTES or holds_more_values(payload, ID_VALUES):
            raise too_long
        return name

    @classmethod
    def from_id(cls, name: str) -> tuple[Animation, str]:
        """Return the animation of an id, and how its model's digest begins; raises RefusedError."""
        try:
            if len(name) > ID_LENGTH:
                raise ValueError
            packed = base64.b64decode(name + "=" * (-len(name) % 4), altchars=b"-_", validate=True)
            inflate = zlib.decompressobj()
            # With a limit, because a short id could unpack to gigabytes.
            payload = inflate.decompress(packed[CHECKSUM_BYTES:], ID_BYTES)
            if (
                not inflate.eof
                or inflate.unused_data
                or packed[:CHECKSUM_BYTES] != _checksum(payload)
                or base64.urlsafe_b64encode(packed).rstrip(b"=").decode() != name
                or holds_more_values(payload, ID_VALUES)
            ):
                raise ValueError
            content = orjson.loads(payload)
            digest = content.pop("model")
            if not isinstance(digest, str) or len(digest) != DIGEST_DIGITS:
                raise ValueError
            return cls.model_validate(content), digest
        except (ValueError, KeyError, AttributeError, TypeError, binascii.Error, zlib.error, ValidationError):
            raise RefusedError(
                "unknown-interpolation",
                "No interpolation has this id: it is damaged or was not given out by this server. "
                "POST the keyframes to /v1/models/{name}/interpolations for a new one.",
            ) from None


def _checksum(payload: bytes) -> bytes:
    return hashlib.sha256(payload).digest()[:CHECKSUM_BYTES]
