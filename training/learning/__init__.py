"""Networks of a run: factor networks, combiners, baselines; fitting, evaluation and export."""


class ExportError(RuntimeError):
    """The exported bundle differs from the networks in PyTorch, or cannot be read."""


class DeviceError(RuntimeError):
    """A device that PyTorch does not find, with a sentence that says what to do."""
