"""Combiners: the corrections of the affine sum of factor shapes, one module for each kind."""
