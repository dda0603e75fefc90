"""A run: configuration, stages, what they leave, and the workers that compute."""
