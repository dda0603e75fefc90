"""Computations in the space of shells for one collection: mean, logarithms, modes, factors."""
