"""The served bundles: their validation in a separate process, and their replacement while requests run."""
