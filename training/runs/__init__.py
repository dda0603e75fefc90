"""The base of all stages: configuration, run directory, samples, workers."""
