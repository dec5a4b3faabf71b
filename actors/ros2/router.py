"""A router of ROS 2 for machines without `rmw_zenohd`; nodes find each other through it.

Leave this node out where the real one runs: `ros2 run rmw_zenoh_cpp rmw_zenohd`.
"""

from __future__ import annotations

import asyncio
import json
from typing import Any

import zenoh

from rampart.actors.bus.zenoh_session import FULL_US
from rampart.actors.runtime.actor import Actor

LISTEN = "tcp/127.0.0.1:7447"

_CONGESTION = "transport/link/tx/queue/congestion_control"
"""While a message waits for the full link of a lost machine, the router passes nothing on. In ROS 2
that lasts 5 s.
"""


class RosRouter(Actor):
    """Listens where nodes of ROS 2 look for their router, and does nothing else."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Endpoint of the router.

        Attributes:
            listen: its endpoint.
        """

        listen: str = LISTEN

    parameters: Parameters
    _session: zenoh.Session | None = None

    def on_start(self) -> None:
        """Open the router; in virtual time there is nothing to open.

        Raises:
            ValueError: a router is there already, or the endpoint is not valid; one line.
        """
        if self.context.run.plan.virtual:
            return
        try:
            self._session = zenoh.open(router_config(self.parameters.listen))
        except zenoh.ZError as error:
            raise ValueError(f"listen = {self.parameters.listen!r}: cannot listen; another router "
                             f"may be running; {' '.join(str(error).split())}") from None

    def on_stop(self) -> None:
        """Close it."""
        if self._session is not None:
            session: Any = self._session
            asyncio.get_running_loop().run_in_executor(None, session.close)


def router_config(listen: str) -> zenoh.Config:
    """Return the configuration of a router that listens at an endpoint."""
    config = zenoh.Config()
    for name, value in {"mode": "router", "listen/endpoints": [listen],
                        "scouting/multicast/enabled": False, "scouting/gossip/enabled": True,
                        "timestamping/enabled": True,
                        f"{_CONGESTION}/block/wait_before_close": FULL_US,
                        f"{_CONGESTION}/drop/max_wait_before_drop_fragments": FULL_US}.items():
        config.insert_json5(name, json.dumps(value))
    return config
