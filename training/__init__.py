"""Offline: from a collection of meshes to a measured bundle of networks."""
