"""The space of a collection: its mean, logarithms, modes and factors."""
