"""One function on many items: in processes on this machine, or on a Dask cluster.

Both give the same result bit for bit, because a result depends on its item alone and is computed with one BLAS thread.
Only processors with different instructions may round differently. If a worker dies, another worker repeats its item.

The machines of a cluster need this package in the same version, with its ``cluster`` extra. They need no common file
system.
"""

from __future__ import annotations

import hashlib
import logging
import operator
import pickle
import sys
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.files.limits import in_words

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Seconds to wait for a scheduler's answer.
CONNECT = 10.0
#: Seconds without any worker after which the run gives up a cluster.
ABANDONED = 60.0
#: Items in flight for each thread of a cluster: one in work, one on its way.
AHEAD = 2
#: Deaths of workers that are tolerated before the item is taken for the cause. On a cluster Dask tolerates three more
#: for each of these.
RETRIES = 3


class WorkersError(RuntimeError):
    """The workers can't be used. The message says why."""


def run(
    function: Callable[[Item], Result], items: Sequence[Item], scheduler: str | None = None, workers: int = -1
) -> Iterator[tuple[int, Result]]:
    """Call a function on each item, and yield (position, result) as results are finished.

    Each thread unpickles the function once and keeps it, so that lazily built attributes are built once in each thread
    and needn't be thread-safe. Without the address of a Dask scheduler all is computed on this machine, in as many
    processes as it has cores unless ``workers`` says otherwise; 1 computes in this process. Raises WorkersError if the
    scheduler can't be reached or is lost, there are no workers, workers lack this package, or an item kills them
    repeatedly.
    """
    if scheduler is not None and items:
        return _on_cluster(PickledFunction(function), items, scheduler)
    if workers == 1 or len(items) < 2:
        return _here(function, items)
    return _in_processes(PickledFunction(function), items, workers)


_kept = threading.local()


class PickledFunction(Generic[Item, Result]):
    """A function that is sent as bytes. A thread unpickles it unless it holds the same function already."""

    def __init__(self, function: Callable[[Item], Result]) -> None:
        pickled = pickle.dumps(function)
        self._digest = hashlib.sha256(pickled).hexdigest()
        # An array, because joblib lets its processes map a large array instead of sending it with every item.
        self._pickled = np.frombuffer(pickled, np.uint8)

    def __call__(self, item: Item) -> Result:
        """Call the function."""
        if getattr(_kept, "digest", None) != self._digest:
            _kept.function = pickle.loads(self._pickled.data)  # noqa: S301 - our own bytes
            _kept.digest = self._digest
        # The limit stays, because another thread of this process may still be computing.
        threadpool_limits(1)
        return _kept.function(item)


def _numbered(function: PickledFunction[Item, Result], k: int, item: Item) -> tuple[int, Result]:
    return k, function(item)


def _itself(function: PickledFunction[Item, Result]) -> PickledFunction[Item, Result]:
    return function


def _here(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
    for k, item in enumerate(items):
        with threadpool_limits(1):
            result = function(item)
        yield k, result


def _in_processes(
    function: PickledFunction[Item, Result], items: Sequence[Item], workers: int
) -> Iterator[tuple[int, Result]]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    # What joblib says when an error or a signal ends a stage, beside the reason that the command says.
    warnings.filterwarnings("ignore", message=r"\d+ tasks (which were|have been)")
    logging.getLogger("concurrent.futures").setLevel(logging.CRITICAL)
    left = dict(enumerate(items))
    for deaths in range(1 + RETRIES):
        # One BLAS thread from the start, for libraries that look at the environment when they are loaded.
        with parallel_config("loky", inner_max_num_threads=1):
            parallel = Parallel(workers, return_as="generator_unordered", batch_size=1)
        try:
            for k, result in parallel(delayed(_numbered)(function, k, item) for k, item in list(left.items())):
                del left[k]
                yield k, result
        except TerminatedWorkerError as error:
            if deaths == RETRIES:
                raise WorkersError(
                    "worker processes were killed several times, probably because memory ran out; close other "
                    "programs, or lower collection.coarse_vertices, and give the same command again"
                ) from error
        else:
            return


def stop() -> None:
    """End the processes of this machine at once. What they compute is lost."""
    loky = sys.modules.get("joblib.externals.loky.reusable_executor")
    if loky is not None and loky._executor is not None:
        loky._executor.shutdown(wait=True, kill_workers=True)


def _on_cluster(
    function: PickledFunction[Item, Result], items: Sequence[Item], scheduler: str
) -> Iterator[tuple[int, Result]]:
    with _client(scheduler) as client:
        from distributed import CancelledError, Future, KilledWorker
        from distributed.comm.core import CommClosedError

        lost = WorkersError(
            f"the connection to the scheduler at {scheduler} was lost; start it again, then give the same command again"
        )
        waiting, deaths = deque(range(len(items))), Counter[int]()
        flying: dict[object, tuple[int, Future]] = {}
        finished: SimpleQueue[Future] = SimpleQueue()
        sent, seen = None, time.monotonic()
        while waiting or flying:
            try:
                threads = sum(client.nthreads().values())
            except (OSError, RuntimeError, AttributeError) as error:  # depends on how far the client is with closing
                raise lost from error
            if threads:
                seen = time.monotonic()
            elif time.monotonic() - seen > ABANDONED:
                raise WorkersError(
                    f"the scheduler at {scheduler} has had no worker for {ABANDONED:.0f} s; start "
                    "workers, then give the same command again"
                )
            while waiting and len(flying) < AHEAD * threads:
                k = waiting.popleft()
                # Dask computes a task's result again if the workers that hold it die; scattered data would be lost.
                sent = sent or client.submit(_itself, function, pure=False)
                future = client.submit(operator.call, sent, items[k], pure=False)
                flying[future.key] = k, future
                future.add_done_callback(finished.put)
            try:
                future = finished.get(timeout=1)
            except Empty:
                continue
            k, _ = flying.pop(future.key)
            try:
                result = future.result()
            except (CancelledError, CommClosedError) as error:
                raise lost from error
            except ModuleNotFoundError as error:
                raise WorkersError(
                    f"a worker of {scheduler} lacks {error.name}: install this package there, with its extra 'cluster'"
                ) from error
            except KilledWorker as error:
                deaths[k] += 1
                if deaths[k] > RETRIES:
                    raise WorkersError(
                        f"workers of {scheduler} died several times at the same samples, probably because memory ran "
                        "out; start fewer workers on each machine"
                    ) from error
                waiting.append(k)
                sent = None
            else:
                yield k, result


def _client(scheduler: str) -> Client:
    try:
        from distributed import Client
    except ImportError as error:
        raise WorkersError("a scheduler needs Dask: pip install 'shapespace[cluster]'") from error
    try:
        return Client(scheduler, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        why = in_words(error, named=False) if isinstance(error, OSError) else error
        raise WorkersError(f"no Dask scheduler answers at {scheduler}: {why}") from error
