"""The calls of the service without HTTP: from values to an answer with diagnostics and timings."""
