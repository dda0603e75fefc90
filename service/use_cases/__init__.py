"""What the service does, without HTTP: shapes, sequences, codes."""
