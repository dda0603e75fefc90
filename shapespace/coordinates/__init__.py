"""Edge lengths and dihedral angles (NRIC): from vertices, back to vertices, and what makes them integrable."""
