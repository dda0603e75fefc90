"""One BLAS thread while shapes are computed: on matrices this small, several threads mostly wait for each other."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ContextDecorator
from functools import cache
from typing import Any

from threadpoolctl import OpenBLASController, ThreadpoolController


class OneBlasThread(ContextDecorator):
    """A context, or a decorator, in which BLAS computes in the thread that calls it.

    The number of threads belongs to the process. It is lowered when the first thread enters, and the user's number
    returns when the last one leaves. So calls may be nested and may overlap.
    """

    _lock = threading.Lock()
    _inside = 0
    _limit: Any = None

    def __enter__(self) -> None:
        cls = OneBlasThread
        with cls._lock:
            if cls._inside == 0:
                cls._limit = _in_control(lambda: _libraries().limit(limits=1, user_api="blas"))
            cls._inside += 1

    def __exit__(self, *_: object) -> None:
        cls = OneBlasThread
        with cls._lock:
            cls._inside -= 1
            if cls._inside == 0:
                _in_control(cls._limit.restore_original_limits)


def _in_control(change: Callable[[], Any]) -> Any:
    """Change the number of threads from any thread: since 3.8 threadpoolctl ignores all but the first one."""
    clear = getattr(OpenBLASController, "clear_controlling_thread", lambda force=False: None)
    clear(force=True)
    try:
        return change()
    finally:
        clear()


@cache
def _libraries() -> ThreadpoolController:
    """Find the BLAS libraries of this process: once, because that takes milliseconds."""
    from scipy import linalg  # noqa: F401 - loads SciPy's BLAS, which is not NumPy's

    return ThreadpoolController()
