"""`rampart ros2`: whether a system and the ROS 2 beside it fit.

`rampart topic list|echo|hz --ros` looks at topics of ROS 2. Neither needs a ROS
installation; pip install 'rampart-robot[ros2]'. ROS_DOMAIN_ID and ROS_DISTRO say
which domain and distribution is meant, as they do to ROS 2.

Examples:
  rampart ros2 check --system warehouse.toml
  rampart topic list --ros
  rampart topic echo /odom --ros tcp/192.168.0.12:7447 -n 1
"""

from __future__ import annotations

import argparse
from collections.abc import Coroutine
from typing import Any

from rampart.cli import systems
from rampart.cli.verbs import JSON, add_family, add_verb, extra


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    ros2 = add_family(verbs, "ros2", "whether a system and the ROS 2 beside it fit", __doc__)
    add_verb(ros2, "check", "router, types, hashes, who is missing", check, systems.choice(), JSON)


def check(options: argparse.Namespace) -> Coroutine[Any, Any, int]:
    """Check a system against the graph of ROS 2 that is there now.

    Say of each [[ros2]] of a system who is on the other side, and why one cannot
    be heard: no router, nobody there, another type, another definition of it, a
    quality of service that cannot meet, somebody who publishes past the gateway.
    Nothing is published, and the system need not run. Exit code 1 if something
    does not fit.

    Examples:
      rampart ros2 check --system warehouse.toml
      rampart ros2 check --system osmosis-ros2 --json
    """
    return look(options).check(options)  # type: ignore[no-any-return]


def look(options: argparse.Namespace) -> Any:
    """Return the module that looks at ROS 2.

    Raises:
        UsageError: the extra is not installed.
    """
    del options
    extra("ros2", "rosbags")
    extra("ros2", "xxhash")
    from rampart.cli.look import ros_topics  # noqa: PLC0415 of the extra

    return ros_topics
