"""A bundle in use: codes to shapes, and shapes back to codes."""
