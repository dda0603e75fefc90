"""For whoever runs the server: its metrics, and loading bundles that changed on disk."""
