"""`rampart ros2`: compare a system with a graph of ROS 2.

Check a system against ROS 2. Over rmw_zenoh this needs no installation of ROS, over
DDS it does. It needs the extra: pip install 'rampart-robot[ros2]'.

Examples:
  rampart ros2 check --system warehouse.toml
"""

from __future__ import annotations

import argparse
from collections.abc import Coroutine
from typing import Any

from rampart.cli import systems
from rampart.cli.verbs import JSON, add_family, add_verb, extra


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    ros2 = add_family(verbs, "ros2", "check a system against ROS 2", __doc__)
    add_verb(ros2, "check", "check routers, types and publishers", check, systems.choice(), JSON)


def check(options: argparse.Namespace) -> Coroutine[Any, Any, int]:
    """Check a system against the present graph of ROS 2.

    List for each [[ros2]] of a system the nodes on the other side, or the problem.
    Problems are: an unreachable router, TLS, no relay, another domain, no node,
    another type, another definition of the type, an incompatible quality of service,
    a publisher that bypasses the gateway, a peer on another machine than the router,
    and an access rule of the router. Nothing is published, and the system need not
    run.

    Examples:
      rampart ros2 check --system warehouse.toml
      rampart ros2 check --system osmosis-ros2 --json

    exit code: 0 no problem, 1 a problem, 2 bad usage
    """
    extra("ros2", "rosbags", "xxhash")
    from rampart.cli.look import ros_check  # noqa: PLC0415 of the extra

    return ros_check.check(options)
