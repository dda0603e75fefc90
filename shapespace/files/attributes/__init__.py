"""What files say of a mesh beside positions and triangles: its polygons, texture coordinates, names and materials."""
