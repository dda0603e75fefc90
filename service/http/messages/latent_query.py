"""Codes in the address: ``?latent=`` and ``?against=``."""

from __future__ import annotations

from shapespace.service.http.problems import ProblemError

_NUMBER = r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?"
#: Pattern of comma-separated numbers in a query, for the description of the interface.
NUMBERS = f"^{_NUMBER}(,{_NUMBER})*$"


def numbers(text: str, name: str) -> list[float]:
    """Read a code from a query; raises ProblemError, invalid-request."""
    try:
        if "_" in text or not text.isascii():  # Python accepts more spellings of numbers than other languages
            raise ValueError
        return [float(part) for part in text.split(",")] if text else []
    except ValueError:
        raise ProblemError(
            "invalid-request", f"{name} is not a list of numbers. Send them separated by commas: ?{name}=0.1,0.2"
        ) from None
