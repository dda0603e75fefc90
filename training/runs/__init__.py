"""What all stages share: configuration, the list of stages, the run directory, samples, workers."""
