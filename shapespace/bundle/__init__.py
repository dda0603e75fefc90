"""Bundles, the files that pass from training to serving: schema, reader and writer."""
