"""Collections of shapes: read and check mesh files, or generate shapes."""
