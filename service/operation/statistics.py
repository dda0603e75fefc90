"""Numbers and times of inferences by model and version, as the Open Inference Protocol's extension counts them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass
class InferenceTally:
    """Inferences of one version of a model since the server started.

    Attributes:
        codes: number of codes in requests that were answered.
        last: time of the latest answer in milliseconds since 1970; 0 before the first.
        counts, seconds: number of requests and their time, by ``success``, ``fail``, and the stages of a success.
    """

    codes: int = 0
    last: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    seconds: dict[str, float] = field(default_factory=dict)

    def add(self, part: str, seconds: float) -> None:
        """Count one request."""
        self.counts[part] += 1
        self.seconds[part] = self.seconds.get(part, 0.0) + seconds

    def succeed(self, codes: int, seconds: float, stages: Mapping[str, float]) -> None:
        """Count a request that was answered, with its time, and its time by stage, as in ``Server-Timing``."""
        self.codes, self.last = self.codes + codes, time.time_ns() // 10**6
        infer, output = stages.get("network", 0.0) + stages.get("reconstruct", 0.0), stages.get("encode", 0.0)
        self.add("success", seconds)
        # Shapes that are computed at the same time may take more time together than the request.
        self.add("queue", max(0.0, seconds - infer - output))
        self.add("compute_infer", infer)
        self.add("compute_output", output)
