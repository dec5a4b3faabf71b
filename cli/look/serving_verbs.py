"""`rampart live`: serve data of the run to other programs.

Serve the run to viewers of Foxglove's protocol, or its figures to Prometheus. Wait
for a run, and for the next one after each run.

Examples:
  rampart live foxglove
  rampart live metrics
"""

from __future__ import annotations

import argparse
from collections.abc import Coroutine
from typing import Any

from rampart.cli.verbs import add_family, add_verb, extra, served

FOXGLOVE_PORT = 8765
"""The default of viewers."""

METRICS_PORT = 9464
"""The default of OpenTelemetry's Prometheus exporter."""


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    viewers = add_family(verbs, "live", "serve the run to Foxglove or Prometheus", __doc__,
                         metavar="VIEWER")
    add_verb(viewers, "foxglove", "serve Foxglove's WebSocket protocol", foxglove,
             *served(FOXGLOVE_PORT, "watch the run"))
    for family, hidden in ((viewers, False), (verbs, True)):
        add_verb(family, "metrics", "serve the run's figures to Prometheus", metrics,
                 *served(METRICS_PORT, "read the figures"), hidden=hidden)


def foxglove(options: argparse.Namespace) -> Coroutine[Any, Any, int]:
    """Serve viewers until interrupted.

    Serve viewers that use Foxglove's WebSocket protocol. They can only read;
    nothing that they send reaches the robot. This needs the extra:
    pip install 'rampart-robot[foxglove]'.

    Examples:
      rampart live foxglove
      rampart live foxglove --port 9000

    Open ws://127.0.0.1:8765 in the viewer, and set the frame of the 3D panel to map.
    """
    extra("foxglove", "foxglove")
    from rampart.cli.look import live_foxglove  # noqa: PLC0415 of the extra

    return live_foxglove.live(options)


def metrics(options: argparse.Namespace) -> Coroutine[Any, Any, int]:
    """Serve figures until interrupted.

    Serve http://HOST:PORT/metrics in Prometheus' text format, or in OpenMetrics
    if the client asks for it: nodes, heartbeats, detections, recoveries,
    decisions, message counts and rates, processes, and figures of the robot.
    Wait for a run, and for the next one after each run; meanwhile rampart_up
    is 0. This needs the extra: pip install 'rampart-robot[prometheus]'.

    Examples:
      rampart live metrics
      rampart live metrics --port 9100 --host 0.0.0.0
      curl -s http://127.0.0.1:9464/metrics | grep node_up
    """
    extra("prometheus", "prometheus_client.exposition")
    from rampart.cli.look import live_metrics  # noqa: PLC0415 of the extra

    return live_metrics.metrics(options)
