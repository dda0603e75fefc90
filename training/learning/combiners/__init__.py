"""Combiners: the corrections of the affine sum of factor shapes, a module for each kind."""
