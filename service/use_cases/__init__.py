"""The calls of the service without HTTP: from values to an answer with diagnostics and timings.

Each waits for a worker on behalf of a ``caller``, and raises RefusedError. It is busy if the queue is full, or if
answers take too much memory. It is deadline-passed, client-closed or not-ready if the call ended before its answer.
"""
