"""HTTP as bytes on a socket, for requests that HTTP clients don't send."""

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
    """Everything that the server still sends until it closes."""
    found = b""
    with contextlib.suppress(ConnectionResetError):
        while piece := connection.recv(2**16):
            found += piece
    return found


def exchange(server: Server, data: bytes) -> bytes:
    """The server's answer to some bytes on a new connection."""
    with connect(server) as connection:
        connection.sendall(data)
        return rest(connection)


def status_and_problem(answer: bytes) -> tuple[int, dict[str, Any]]:
    """Status and problem document of the first answer in some bytes."""
    head, _, body = answer.partition(b"\r\n\r\n")
    assert b"application/problem+json" in head, answer[:500]
    return int(head.split()[1]), json.loads(body)
