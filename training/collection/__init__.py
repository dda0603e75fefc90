"""Collections: mesh files read and checked, and synthetic ones generated."""
