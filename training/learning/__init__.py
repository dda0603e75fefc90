"""The networks: factors, the combiner with its kinds of correction, baselines; fitting, evaluation, export."""


class ExportError(RuntimeError):
    """The bundle would not compute what the networks compute, or could not be read."""
