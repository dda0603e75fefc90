"""ONNX networks with a time limit for each run."""

import logging
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from shapespace.bundle.reader import LONGEST_REASON, Bundle, BundleError
from shapespace.bundle.schema import Network

#: Time limit of the networks for one code, in seconds: hundreds of times what they need.
PATIENCE = 5.0
#: After a timeout, the time limit is halved, down to LEAST_PATIENCE seconds. Each answer in time multiplies it by
#: RECOVERY. Otherwise repeated requests for slow codes would occupy all workers.
LEAST_PATIENCE, RECOVERY = 0.5, 1.1
logger = logging.getLogger(__name__)
#: Log only fatal errors: ONNX Runtime's messages quote names from the file, which may come from an untrusted source.
_FATAL = 4
onnxruntime.set_default_logger_severity(_FATAL)


class NetworkError(RuntimeError):
    """A network failed at a code; the message has the reason."""


class TerminatedError(NetworkError):
    """A network was stopped at its time limit."""


class ModelFailedError(RuntimeError):
    """Networks failed at a code. The message says what to do, and the cause names the network and the fault."""


class NetworkTimeError(ModelFailedError):
    """Networks exceeded their time limit at a code."""


class Patience:
    """Time limit of all networks of a model for one code, see LEAST_PATIENCE. ``model`` is its name for the log."""

    def __init__(self, model: str) -> None:
        self._model = model
        self.seconds = PATIENCE

    @contextmanager
    def limited(self) -> Iterator[float]:
        """Yield the time at which networks must have answered; turn their errors into ModelFailedError."""
        seconds = self.seconds
        try:
            yield time.monotonic() + seconds
            self.seconds = min(PATIENCE, RECOVERY * self.seconds)
        except NetworkError as error:
            logger.error("model %s: %s", self._model, error)
            what_to_do = "Choose another code or model, and tell the operator of the server."
            if isinstance(error, TerminatedError):
                self.seconds = max(seconds / 2, LEAST_PATIENCE)
                raise NetworkTimeError(
                    f"The model's networks did not answer within {seconds:g} s at this code. {what_to_do}"
                ) from error
            raise ModelFailedError(f"The model's networks failed at this code. {what_to_do}") from error


class _Watch:
    """Ends runs at their time limit. One thread watches all runs.

    ONNX Runtime checks a run's flag between two nodes, also in the bodies of loops.
    """

    #: Interval between checks, in seconds.
    STEP = 0.1

    def __init__(self) -> None:
        self._runs: dict[int, tuple[float, onnxruntime.RunOptions]] = {}
        self._some = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def begin(self, options: onnxruntime.RunOptions, until: float) -> None:
        """Watch a run, which must end at the time ``until`` of ``time.monotonic``."""
        self._runs[id(options)] = until, options
        if not self._some.is_set():
            self._wake()

    def end(self, options: onnxruntime.RunOptions) -> None:
        """Stop watching a run that has ended."""
        del self._runs[id(options)]

    def _wake(self) -> None:
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._look, name="networks", daemon=True)
                self._thread.start()
        self._some.set()

    def _look(self) -> None:
        while self._some.wait():
            time.sleep(self.STEP)
            now = time.monotonic()
            for until, options in self._runs.copy().values():
                if now > until:
                    options.terminate = True
            if not self._runs:
                self._some.clear()
                if self._runs:  # a run that began in the meantime found the flag still set
                    self._some.set()


_watch = _Watch()


class Session:
    """One ONNX network, whose input and output match the manifest. Rows of its input and output have the shapes
    ``inputs`` and ``outputs``. ``content`` replaces its file. Raises BundleError if the network doesn't load, or has
    other inputs or outputs.
    """

    def __init__(
        self, bundle: Bundle, network: Network, inputs: list[int], outputs: list[int], content: bytes | None = None
    ) -> None:
        options = onnxruntime.SessionOptions()
        # Callers already decode in several threads, which more threads would slow down. The arena would never release
        # the memory of the largest run.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.enable_cpu_mem_arena = False
        options.log_severity_level = _FATAL
        try:
            self._session = onnxruntime.InferenceSession(
                content or bundle.networks[network.file], options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime's exceptions have no common public class
            raise BundleError(f"{network.file} does not load: {_first_line(error)}") from None
        self._session.disable_fallback()  # there is no fallback, and it prints
        for role, nodes, name, row in (
            ("input", self._session.get_inputs(), network.input, inputs),
            ("output", self._session.get_outputs(), network.output, outputs),
        ):
            if [node.name for node in nodes] != [name] or not _fits(nodes[0], row):
                have = ", ".join(f"{node.name} {node.type} {node.shape}" for node in nodes)
                raise BundleError(f"{network.file} must have one {role}, {name} float32 [n, {row}], but has {have}")
        # ONNX Runtime keeps the file in case its providers change. This frees 20 MB with both bundled models.
        self._session._model_bytes = None
        self._file, self._input, self._output = network.file, network.input, network.output
        self._row, self._shape = tuple(inputs), tuple(outputs)

    def check(self) -> None:
        """Run the network on two rows of zeros; raises BundleError unless the output is finite."""
        try:
            result = self(np.zeros((2, *self._row), np.float32), time.monotonic() + PATIENCE)
        except NetworkError as error:
            raise BundleError(f"{error}, for zeros") from None
        if not np.isfinite(result).all():
            raise BundleError(f"{self._file} does not give finite numbers for zeros")

    def __call__(
        self, rows: NDArray[np.float32], until: float, options_by_name: Mapping[str, NDArray[np.float32]] | None = None
    ) -> NDArray[np.float32]:
        """Return outputs for rows (n, …) before the time ``until`` of ``time.monotonic``.

        ``options_by_name`` are optional inputs. Raises TerminatedError if the time was over, and NetworkError if the
        network failed or its output has another shape.
        """
        options = onnxruntime.RunOptions()
        options.log_severity_level = _FATAL
        _watch.begin(options, until)
        try:
            result: Any = self._session.run([self._output], {self._input: rows, **(options_by_name or {})}, options)[0]
        except Exception as error:  # as above
            if options.terminate:
                raise TerminatedError(f"{self._file} does not answer in time") from None
            raise NetworkError(f"{self._file} fails: {_first_line(error)}") from None
        finally:
            _watch.end(options)
        if result.shape != (len(rows), *self._shape):
            raise NetworkError(f"{self._file} gives {result.shape}, not {(len(rows), *self._shape)}")
        return result


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:LONGEST_REASON]


def _fits(node: Any, row: list[int]) -> bool:
    """Return whether a value is float32 with a free first dimension, and whether known dimensions match a row."""
    shape = node.shape
    return (
        node.type == "tensor(float)"
        and len(shape) == 1 + len(row)
        and not isinstance(shape[0], int)
        and all(size == want or not isinstance(size, int) for size, want in zip(shape[1:], row, strict=True))
    )
