"""Metrics for Prometheus. Requests cannot add values of labels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, disable_created_metrics
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from shapespace import __version__
from shapespace.service.limits.quota import Quota
from shapespace.service.limits.workers import Workers
from shapespace.service.repository.repository import Changes, ModelRepository

#: Upper ends of histogram buckets in seconds, from a cached answer to the default deadline.
BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60)
# Series that say when each series first appeared; Prometheus needs none of them.
disable_created_metrics()  # type: ignore[no-untyped-call]
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class Metrics:
    """Metrics of one server, in a registry of their own."""

    def __init__(
        self, registry: CollectorRegistry, repository: ModelRepository, workers: Workers, connections: Quota
    ) -> None:
        ProcessCollector(registry=registry)
        registry.register(_ModelInfo(repository))

        def counter(name: str, text: str, *labels: str) -> Counter:
            return Counter(f"shapespace_{name}", text, labels, registry=registry)

        def histogram(name: str, text: str, *labels: str) -> Histogram:
            return Histogram(f"shapespace_{name}", text, labels, buckets=BUCKETS, registry=registry)

        self._requests = counter("requests", "Requests answered.", "route", "method", "status")
        text = "Time from a request's head to the end of its answer."
        self._seconds = histogram("request_seconds", text, "route", "method", "status", "model")
        text = "Requests that a version of a model answered."
        self._versions = counter("version_requests", text, "model", "version", "status")
        self._hits = counter("cache_hits", "Answers that were taken from the cache.")
        self._misses = counter("cache_misses", "Answers that were computed because the cache did not have them.")
        self._stages = histogram(
            "stage_seconds", "Time of a computed answer by stage, as its Server-Timing says.", "stage"
        )
        text = "Bundles that reloads loaded, removed or refused, and reloads that failed whole."
        self._reloads = counter("reloaded_bundles", text, "result")
        self._refusals = counter("refusals", "Connections that were refused without a whole request.", "kind")
        for name, text, value in (
            ("bundles_refused", "Bundles that the latest reload refused.", lambda: len(repository.refused)),
            ("default_version_faults", "Default versions that are not served.", lambda: len(repository.faults)),
            ("admitted", "Requests at work or waiting for a worker.", lambda: workers.places.used),
            (
                "admitted_limit",
                "Limit of requests at work or waiting; further requests get 503.",
                lambda: workers.places.limit,
            ),
            ("streams", "Streams of JSON lines that are open.", lambda: workers.streams.used),
            ("streams_limit", "Limit of open streams; further streams get 503.", lambda: workers.streams.limit),
            ("connections", "Open connections.", lambda: connections.used),
            ("connections_limit", "Limit of open connections.", lambda: connections.limit),
            ("workers", "Shapes computed at once.", lambda: workers.threads),
        ):
            Gauge(f"shapespace_{name}", text, registry=registry).set_function(value)
        Gauge("shapespace_build_info", "Always 1.", ["version"], registry=registry).labels(__version__).set(1)

    def answered(self, route: str, method: str, status: int, seconds: float, model: str, version: str) -> None:
        """Count an answer, by the template of its path, and with one label for all unknown methods.

        ``model`` and ``version`` are of a served model, or empty where none answered.
        """
        method = method if method in METHODS else "other"
        self._requests.labels(route, method, str(status)).inc()
        self._seconds.labels(route, method, str(status), model).observe(seconds)
        if model:
            self._versions.labels(model, version, str(status)).inc()

    def looked_up(self, *, found: bool) -> None:
        """Count whether the cache had an answer."""
        (self._hits if found else self._misses).inc()

    def timed(self, seconds: Mapping[str, float]) -> None:
        """Count the time of a computed answer by stage, without stages that it did not need."""
        for stage, duration in seconds.items():
            if duration:
                self._stages.labels(stage).observe(duration)

    def refused(self, kind: str) -> None:
        """Count a connection refused before a whole request arrived."""
        self._refusals.labels(kind).inc()

    def reloaded(self, changes: Changes) -> None:
        """Count the results of a reload."""
        for result in ("loaded", "removed", "refused"):
            self._reloads.labels(result).inc(len(getattr(changes, result)))
        self._reloads.labels("failed").inc(changes.failed)


class _ModelInfo(Collector):
    """Names, versions and digests of the served models, and the share of the codes that each version answers."""

    def __init__(self, repository: ModelRepository) -> None:
        self._repository = repository

    def collect(self) -> Iterator[Metric]:
        info = GaugeMetricFamily("shapespace_model_info", "Always 1.", labels=["model", "version", "digest"])
        text = "Share of the codes that a version answers if requests name none, from 0 to 1."
        share = GaugeMetricFamily("shapespace_version_share", text, labels=["model", "version"])
        for model in self._repository.all():
            place = [model.manifest.name, model.manifest.version]
            info.add_metric([*place, model.digest], 1)
            share.add_metric(place, self._repository.share(model))
        yield from (info, share)
