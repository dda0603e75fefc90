"""How work is bounded: threads with a queue and a deadline, processes that can be ended, memory, shares of clients. The
numbers are in `settings` or beside the check.
"""
