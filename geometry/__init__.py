"""The mathematics both sides share: triangle meshes, their lengths and angles, and the way back to vertices."""
