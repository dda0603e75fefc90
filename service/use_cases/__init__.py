"""The calls of the service without HTTP: from values to an answer with diagnostics and timings.

Each waits for a worker on behalf of a ``caller``, and raises BusyError if the queue is full, or if answers take too
much memory, and DeadlineError, DisconnectedError or EndingError if the call ended before the answer was ready.
"""
