"""Shapes over HTTP: bundles in ``models/`` at work behind the calls of ``openapi/openapi.json``."""
