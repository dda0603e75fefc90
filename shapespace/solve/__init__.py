"""Parts of iterations: Cholesky, preconditioner, mixing, line search, least squares, truncated Newton, `Outcome`."""
