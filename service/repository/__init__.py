"""The bundles that are served, how they are tried, and how they change."""
