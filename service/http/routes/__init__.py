"""Routes, one module for each group of calls; they translate between HTTP and the use cases."""
