"""Learned product shape manifolds of triangle meshes: a handful of numbers in, a shape out."""

__version__ = "0.1.0"
