"""What the service does, without HTTP: values in; answer, diagnostics and timings out."""
