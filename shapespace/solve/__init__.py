"""Parts of iterations: Cholesky, preconditioner, acceleration, line search, least squares, Newton and `Outcome`."""
