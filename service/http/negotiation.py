"""The media type of a body, and the choice of a format by ``?format=``, ``Accept``, or the default."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from starlette.datastructures import Headers

from shapespace.service.refusals import RefusedError

#: Number of media ranges of an ``Accept`` that are read, the first ones; browsers send less than ten.
MOST_RANGES = 100


def declared_type(headers: Mapping[str, str]) -> str:
    """Return the media type that a body declares, without parameters; empty if it declares none."""
    return headers.get("content-type", "").split(";")[0].strip().lower()


def listed(headers: Headers, name: str) -> str | None:
    """Return a header that is a list, and may come in several parts; None without it (RFC 9110, 5.3)."""
    return ", ".join(headers.getlist(name)) or None


def choose(
    formats: Mapping[str, str],
    format: str | None,
    accept: str | None,
    unavailable: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Return the name of the format to answer in; raises RefusedError, not-acceptable, with the choices.

    Args:
        formats: media type of each format by name. The first is the default. ``Accept`` gets the first of two
            formats with one media type.
        format: the query parameter ``format``.
        accept: the header ``Accept``.
        unavailable: reason why a format is missing that a client may expect, by name.
    """
    if format is not None:
        if (name := format.lower()) in formats:
            return name
        raise _not_acceptable(formats, unavailable.get(name, f"There is no format {format!r} here"))
    if accept is None or not accept.strip():
        return next(iter(formats))
    ranges = [_parse(part) for part in accept.split(",", maxsplit=MOST_RANGES)[:MOST_RANGES] if part.strip()]
    weights = {name: _weight(media_type, ranges) for name, media_type in formats.items()}
    best = max(weights, key=lambda name: weights[name])  # the first of equals
    if weights[best] <= 0:
        raise _not_acceptable(formats, f"Nothing here is {accept!r}")
    return best


def _parse(part: str) -> tuple[str, float]:
    media_range, *parameters = (piece.strip().lower() for piece in part.split(";"))
    for parameter in parameters:
        key, _, value = parameter.partition("=")
        if key.strip() == "q":
            try:
                return media_range, min(1.0, max(0.0, float(value)))
            except ValueError:
                return media_range, 0.0
    return media_range, 1.0


def _weight(media_type: str, ranges: list[tuple[str, float]]) -> float:
    """Return the weight of the most specific range that covers a media type; 0 if none does (RFC 9110, 12.5.1)."""
    for pattern in (media_type, media_type.split("/", maxsplit=1)[0] + "/*", "*/*"):
        weights = [weight for media_range, weight in ranges if media_range == pattern]
        if weights:
            return max(weights)
    return 0.0


def _not_acceptable(formats: Mapping[str, str], fault: str) -> RefusedError:
    choices = [{"format": name, "media_type": media_type} for name, media_type in formats.items()]
    listed = ", ".join(f"{name} ({media_type})" for name, media_type in formats.items())
    error = RefusedError("not-acceptable", f"{fault}. Choose one of {listed} by ?format= or Accept.", choices=choices)
    error.headers = {"Vary": "Accept"}
    return error
