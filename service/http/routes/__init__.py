"""The calls, one module a group; each only translates between HTTP and the service's parts."""
