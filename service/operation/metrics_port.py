"""Metrics on a port of their own, without a key, for Prometheus inside the cluster."""

from __future__ import annotations

import logging
import socket
import socketserver
import threading
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

logger = logging.getLogger(__name__)
#: Seconds in which a client has to send its request or read its answer.
PATIENCE = 5.0


class MetricsPort:
    """A port that answers ``/metrics`` in a thread, one client after the other, also while the event loop is busy.

    It answers until the process ends.

    Args:
        host, port: address to listen on; port 0 takes a free one.

    Raises:
        OSError: the address is not free, or the machine does not have it.
    """

    def __init__(self, host: str, port: int) -> None:
        family, *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self._server = (_Server6 if family == socket.AF_INET6 else _Server4)((host, port), _QuietHandler)

    def serve(self, registry: CollectorRegistry) -> None:
        """Begin to answer these metrics."""
        self._server.set_app(make_wsgi_app(registry))
        threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True).start()
        logger.info("/metrics is at port %d too, without a key", self._server.server_port)


class _QuietHandler(WSGIRequestHandler):
    timeout = PATIENCE

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, since scrapes come every few seconds."""


class _Server4(WSGIServer):
    def server_bind(self) -> None:
        """Bind without a look-up of the host's name, which can take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = self.server_address[:2]  # type: ignore[assignment]
        self.setup_environ()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore clients that leave."""


class _Server6(_Server4):
    address_family = socket.AF_INET6
