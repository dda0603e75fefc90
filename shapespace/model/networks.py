"""ONNX networks, each run with a limit of time."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from shapespace.bundle.reader import LONGEST_REASON, Bundle, BundleError
from shapespace.bundle.schema import Network

#: Seconds that the networks may take for one code, hundreds of times what they need.
PATIENCE = 5.0
#: Only what ends the process is logged: ONNX Runtime's messages quote names from the file, which a stranger chose.
_FATAL = 4
onnxruntime.set_default_logger_severity(_FATAL)


class NetworkError(RuntimeError):
    """A network that gives no answer at a code, with the reason."""


class TerminatedError(NetworkError):
    """A network that was stopped because its time was over."""


class _Watch:
    """Ends runs that take too long: one thread for all of them, which looks at the clock while there are any.

    ONNX Runtime looks at a run's flag between two nodes, in the bodies of loops too.
    """

    #: Seconds from one look to the next.
    STEP = 0.1

    def __init__(self) -> None:
        self._runs: dict[int, tuple[float, onnxruntime.RunOptions]] = {}
        self._some = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def begin(self, options: onnxruntime.RunOptions, until: float) -> None:
        """Watch over a run, which must end by this moment of ``time.monotonic``."""
        self._runs[id(options)] = until, options
        if not self._some.is_set():
            self._wake()

    def end(self, options: onnxruntime.RunOptions) -> None:
        """Stop watching over a run that has ended."""
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
                if self._runs:  # a run that has begun since then found the flag still set
                    self._some.set()


_watch = _Watch()


class Session:
    """One ONNX network whose input and output are those of the manifest.

    Args:
        bundle: holds its bytes.
        network: names of file, input and output.
        inputs, outputs: expected shape of one row.

    Raises:
        BundleError: it doesn't load, or has other inputs or outputs.
    """

    def __init__(self, bundle: Bundle, network: Network, inputs: list[int], outputs: list[int]) -> None:
        options = onnxruntime.SessionOptions()
        # Callers decode in several threads already, and more threads inside each would compete with them. The arena
        # would keep the memory of the largest run for ever.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.enable_cpu_mem_arena = False
        options.log_severity_level = _FATAL
        try:
            self._session = onnxruntime.InferenceSession(
                bundle.networks[network.file], options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime's exceptions have no common public class
            raise BundleError(f"{network.file} does not load: {_first_line(error)}") from None
        self._session.disable_fallback()  # there is none, and it prints
        for role, nodes, name, row in (
            ("input", self._session.get_inputs(), network.input, inputs),
            ("output", self._session.get_outputs(), network.output, outputs),
        ):
            if [node.name for node in nodes] != [name] or not _fits(nodes[0], row):
                have = ", ".join(f"{node.name} {node.type} {node.shape}" for node in nodes)
                raise BundleError(f"{network.file} must have one {role}, {name} float32 [n, {row}], but has {have}")
        # ONNX Runtime keeps the file in case its providers change, which they don't: 20 MB with both bundled models.
        self._session._model_bytes = None
        self._file, self._input, self._output = network.file, network.input, network.output
        self._row, self._shape = tuple(inputs), tuple(outputs)

    def check(self) -> None:
        """Run the network once, for two rows of zeros; raises BundleError unless it answers finite numbers."""
        try:
            result = self(np.zeros((2, *self._row), np.float32), time.monotonic() + PATIENCE)
        except NetworkError as error:
            raise BundleError(f"{error}, for zeros") from None
        if not np.isfinite(result).all():
            raise BundleError(f"{self._file} does not give finite numbers for zeros")

    def __call__(self, rows: NDArray[np.float32], until: float) -> NDArray[np.float32]:
        """Outputs for rows (n, …), by that moment of ``time.monotonic``.

        Raises:
            TerminatedError: the moment came first.
            NetworkError: it failed, or gave something else than it should.
        """
        options = onnxruntime.RunOptions()
        options.log_severity_level = _FATAL
        _watch.begin(options, until)
        try:
            result: Any = self._session.run([self._output], {self._input: rows}, options)[0]
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
    """Whether a value is float32 with a free first dimension, and the known others as wanted."""
    shape = node.shape
    return (
        node.type == "tensor(float)"
        and len(shape) == 1 + len(row)
        and not isinstance(shape[0], int)
        and all(size == want or not isinstance(size, int) for size, want in zip(shape[1:], row, strict=True))
    )
