"""Triangle meshes: connectivity, quality, rigid motion, coarse meshes, and fine ones carried along with them."""
