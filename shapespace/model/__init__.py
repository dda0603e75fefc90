"""One bundle at work: codes to shapes, and shapes back to codes."""
