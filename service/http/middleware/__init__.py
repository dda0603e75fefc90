"""ASGI middleware that every request passes through before the routes."""
