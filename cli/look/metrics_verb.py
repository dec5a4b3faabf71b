"""`rampart metrics`: the run's figures for Prometheus."""

from __future__ import annotations

import argparse
from collections.abc import Coroutine
from typing import Any

from rampart.cli.verbs import add_verb, extra, served

PORT = 9464
"""The port that OpenTelemetry's Prometheus exporter has by convention, too."""


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "metrics", "serve the run's figures to Prometheus", metrics,
             *served(PORT, "read the figures"))


def metrics(options: argparse.Namespace) -> Coroutine[Any, Any, int]:
    """Serve figures until interrupted.

    Serve http://HOST:PORT/metrics in Prometheus' text format, or in OpenMetrics
    for who asks for it: nodes, heartbeats, detections, recoveries, decisions,
    message counts and rates, processes, what the robot adds. Waits for a run,
    and for the next when one ends; meanwhile rampart_up is 0.
    Needs the extra: pip install 'rampart[prometheus]'.

    Examples:
      rampart metrics
      rampart metrics --port 9100 --host 0.0.0.0
      curl -s http://127.0.0.1:9464/metrics | grep node_up
    """
    extra("prometheus", "prometheus_client.exposition")
    from rampart.cli.look import metrics_server  # noqa: PLC0415 of the extra

    return metrics_server.metrics(options)
