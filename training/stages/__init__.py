"""The stages of a run: one file for each, with its version, settings, results, warnings and work."""
