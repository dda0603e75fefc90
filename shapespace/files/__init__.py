"""Mesh and animation files, read and written; the only room that knows trimesh and pxr."""
