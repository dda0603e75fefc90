"""Every kind of request: importing the package fills `requests.KINDS`."""

from tests.fuzz.kinds import heads, json_bodies, large_answers, uploads, wire
from tests.fuzz.kinds.requests import KINDS, World, made, shares

__all__ = ["KINDS", "World", "heads", "json_bodies", "large_answers", "made", "shares", "uploads", "wire"]
