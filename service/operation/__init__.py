"""Metrics of the server, and reloading of bundles that changed on disk."""
