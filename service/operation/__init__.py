"""Running the server: what it counts, and taking up changed bundles."""
