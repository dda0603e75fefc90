"""Numbers in the words of a report: digits, percent, durations and sizes."""

import math
from collections.abc import Iterator
from decimal import Decimal
from typing import Any

#: Most decimals of a number that is close to a whole.
MOST_DIGITS = 15
#: Smaller shares differ from 0 by nothing that anybody sees.
TINY = 1e-5


def flatten(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values in nested dictionaries and lists, each with its path."""
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from flatten(inner, f"{name} · {key}" if name else str(key))
    else:
        yield name, value


def figure(value: Any) -> str:
    """Format a number with four digits; return anything else as it stands."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return "–" if not math.isfinite(value) else f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def r2(value: float | None) -> str:
    """Format a coefficient of determination with four decimals, or with as many as keep it from rounding up to 1."""
    return "–" if value is None or not math.isfinite(value) else short_of(value, 4)


def short_of(value: float, digits: int, whole: float = 1.0) -> str:
    """Format a number with some decimals, or with as many as keep it from rounding up to the whole."""
    while value < whole and digits < MOST_DIGITS and float(f"{value:.{digits}f}") >= whole:
        digits += 1
    return f"{value:.{digits}f}"


def plain(value: float, digits: int) -> str:
    """Format a number with some significant digits, without an exponent."""
    return f"{Decimal(f'{value:.{digits}g}'):f}"


def percent(value: float, digits: int = 2) -> str:
    """Format a share as a percentage with some significant digits, or as less than `TINY`."""
    if 0 < value < TINY:
        return f"< {plain(100 * TINY, 1)}\N{NO-BREAK SPACE}%"
    return f"{plain(100 * value, digits)}\N{NO-BREAK SPACE}%"


def duration(seconds: float | None) -> str:
    """Format seconds in the unit that suits them."""
    if seconds is None or not math.isfinite(seconds):
        return "–"
    if seconds < 0.9995:
        return f"{1000 * seconds:.3g}\N{NO-BREAK SPACE}ms"
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{plain(seconds / length, 3)}\N{NO-BREAK SPACE}{unit}"
    return f"{seconds:.3g}\N{NO-BREAK SPACE}s"


def size(value: float) -> str:
    """Format bytes as megabytes."""
    return f"{plain(value / 1e6, 3)}\N{NO-BREAK SPACE}MB"
