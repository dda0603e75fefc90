"""Spans of OpenTelemetry for the stages of an answer, where a provider is configured.

FastAPI makes the span of each request, as a child of the span that the header ``traceparent`` names.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

try:
    from opentelemetry import trace
except ImportError:  # a later FastAPI may not bring it
    trace = None  # type: ignore[assignment]


def record_stages(seconds: Mapping[str, float]) -> None:
    """Record stages that have run one after the other and have just ended, as children of the request's span."""
    if trace is None or not trace.get_current_span().is_recording():
        return
    tracer, end = trace.get_tracer("shapespace"), time.time_ns()
    for stage, duration in reversed([*seconds.items()]):
        start = end - int(1e9 * duration)
        tracer.start_span(stage, start_time=start).end(end)
        end = start
