"""Limits on work: worker threads, processes that can be killed, memory, and quotas of clients.

The numbers are in `settings`, or beside the check.
"""
