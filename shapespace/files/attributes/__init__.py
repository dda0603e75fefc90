"""Polygons, texture coordinates, names and materials of a mesh, in each file format."""
