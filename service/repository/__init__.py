"""The bundles that are served, how they are validated, and how they change."""
