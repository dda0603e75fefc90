"""The server: shapes of the bundles in ``models/`` over HTTP, with the calls of ``openapi/openapi.json``."""
