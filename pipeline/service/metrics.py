"""What a monitor reads at ``/metrics``: requests and their durations, uploads, jobs by state, trials (Prometheus)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from pipeline import __version__
from pipeline.service.database import STATES

MEDIA = "text/plain; version=0.0.4; charset=utf-8"
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")
BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 60.0)
"""Ends of the ranges of durations [s]."""


class Metrics:
    """Numbers of one server.

    Parameters
    ----------
    jobs : callable
        Number of jobs by state.
    trials : callable
        Number of stored trials.
    """

    def __init__(self, jobs: Callable[[], Mapping[str, int]], trials: Callable[[], int]) -> None:
        self.registry = CollectorRegistry()
        names = ("method", "route", "status")
        self._requests = Counter("pipeline_requests", "Requests.", names, registry=self.registry)
        self._seconds = Histogram(
            "pipeline_request_seconds", "Durations.", names[1:2], buckets=BUCKETS, registry=self.registry
        )
        self._files = Counter("pipeline_uploaded_files", "Files of uploads, by what became of them.", ("state",),
                              registry=self.registry)  # fmt: skip
        self._bytes = Counter("pipeline_uploaded_bytes", "Bytes of uploads.", registry=self.registry)
        waiting = Gauge("pipeline_jobs", "Jobs by state.", ("state",), registry=self.registry)
        for state in STATES:
            waiting.labels(state).set_function(partial(_number, jobs, state))
        Gauge("pipeline_trials", "Stored trials.", registry=self.registry).set_function(trials)
        Gauge("pipeline_version", "1.", ("version",), registry=self.registry).labels(__version__).set(1)

    def answered(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request; a route is a pattern, so that names in addresses make no numbers of their own."""
        self._requests.labels(method if method in METHODS else "other", route, str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def uploaded(self, files: list[dict[str, Any]]) -> None:
        """Count the files of an upload."""
        for file in files:
            self._files.labels(file["state"]).inc()
            self._bytes.inc(file["size"])

    def text(self) -> bytes:
        """Return all in the format of Prometheus."""
        return generate_latest(self.registry)


def _number(jobs: Callable[[], Mapping[str, int]], state: str) -> float:
    return jobs().get(state, 0)
