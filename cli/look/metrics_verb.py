"""`rampart metrics`: the run's figures for Prometheus."""

from __future__ import annotations

import argparse
import asyncio
from typing import Any

from rampart.cli.extras import extra

PORT = 9464
"""The port that OpenTelemetry's Prometheus exporter has by convention, too."""

_LOOPBACK = "127.0.0.1"


def add(verbs: Any, formatter: Any) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser(
        "metrics", formatter_class=formatter, help="serve the run's figures to Prometheus",
        description="Serve http://HOST:PORT/metrics in Prometheus' text format, or in OpenMetrics\n"
                    "for who asks for it: nodes, heartbeats, detections, recoveries, decisions,\n"
                    "message counts and rates, processes, what the robot adds. Waits for a run,\n"
                    "and for the next when one ends; meanwhile rampart_up is 0.\n"
                    "Needs the extra: pip install 'rampart[prometheus]'.",
        epilog="examples:\n  rampart metrics\n  rampart metrics --port 9100 --host 0.0.0.0\n"
               "  curl -s http://127.0.0.1:9464/metrics | grep node_up")
    parser.add_argument("--port", type=int, default=PORT, metavar="N",
                        help=f"port to serve on (default {PORT})")
    parser.add_argument("--host", default=_LOOPBACK, metavar="ADDRESS",
                        help=f"address to serve on (default {_LOOPBACK}; whoever reaches it may "
                             "read the figures)")
    parser.add_argument("--run", dest="of", type=int, metavar="N",
                        help="base port of the run, if there are several on this machine")
    parser.set_defaults(run=_metrics)


def _metrics(options: argparse.Namespace) -> int:
    extra("prometheus", "prometheus_client.exposition")
    from rampart.cli.look.metrics_server import metrics  # noqa: PLC0415 of the extra

    return asyncio.run(metrics(options))
