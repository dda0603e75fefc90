"""What the nonlinear solvers are made of: factorisations, acceleration, descent, and how an iteration ended."""
