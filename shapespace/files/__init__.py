"""Reading and writing of mesh and animation files. Only this package imports trimesh and pxr."""
