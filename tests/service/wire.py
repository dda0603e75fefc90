"""HTTP as bytes on a socket, for what a decent client doesn't send."""

from __future__ import annotations

import contextlib
import json
import socket
from typing import Any

import httpx

from tests.service.conftest import Server


def connect(server: Server, source: str = "127.0.0.1") -> socket.socket:
    """A connection from an address of this machine."""
    place = httpx.URL(server.url)
    return socket.create_connection((place.host, place.port), timeout=60, source_address=(source, 0))


def rest(connection: socket.socket) -> bytes:
    """All that still comes, until the server closes."""
    found = b""
    with contextlib.suppress(ConnectionResetError):
        while piece := connection.recv(2**16):
            found += piece
    return found


def exchange(server: Server, data: bytes) -> bytes:
    """What comes back for some bytes."""
    with connect(server) as connection:
        connection.sendall(data)
        return rest(connection)


def status_and_problem(answer: bytes) -> tuple[int, dict[str, Any]]:
    """Of the first answer in some bytes."""
    head, _, body = answer.partition(b"\r\n\r\n")
    assert b"application/problem+json" in head, answer[:500]
    return int(head.split()[1]), json.loads(body)
