"""Codes in the address: ``?latent=`` and ``?against=``."""

from __future__ import annotations

from shapespace.service.http.problems import ProblemError

_NUMBER = r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?"
#: What the description says of numbers in a query.
NUMBERS = f"^{_NUMBER}(,{_NUMBER})*$"


def numbers(text: str, name: str) -> list[float]:
    """A code in a query; raises ProblemError, invalid-request."""
    try:
        if "_" in text or not text.isascii():  # Python reads more as a number than others
            raise ValueError
        return [float(part) for part in text.split(",")] if text else []
    except ValueError:
        raise ProblemError(
            "invalid-request", f"{name} is not a list of numbers. Send them separated by commas: ?{name}=0.1,0.2"
        ) from None
