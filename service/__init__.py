"""Shapes over HTTP: bundles in ``models/`` at work behind the calls of ``openapi/openapi.json``."""

__version__ = "0.1.0"
