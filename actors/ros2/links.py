"""Topics of ROS 2 that are passed on, one way or the other, while the gateway runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import msgspec

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.topic import Qos as BusQos
from rampart.actors.bus.topic import Topic
from rampart.actors.ros2.graph import RosGraph
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.ros_clock import RosClock
from rampart.actors.ros2.translation.mapping import Inward, NotMeantError, Outward
from rampart.actors.ros2.translation.tables import Ros2Link
from rampart.actors.ros2.wire import Attachment, Qos

HEARD_LATELY_S = 1.0
"""A publisher that is silent for so long, simulated seconds, gives way to another."""

_ROUNDING = 0.999

_ZEROS = 20
"""So many times zeros are said when the system has fallen silent."""


class Host(Protocol):
    """What a link needs of the gateway.

    Attributes:
        node: in ROS 2.
        graph: of ROS 2.
        time: of ROS 2.
    """

    node: RosNode
    graph: RosGraph
    time: RosClock

    def now_s(self) -> float:
        """Return simulated time."""

    def newest(self, key: str) -> tuple[msgspec.Struct, float] | None:
        """Return what was said last on a topic of the system, and its stamp."""

    def say(self, topic: Topic[Any], body: msgspec.Struct, stamp_s: float | None) -> None:
        """Publish to the system."""

    def refuse(self, where: str, why: str) -> None:
        """Tell that something was not passed on."""

    def handle(self, slot: str | None, call: Callable[[], None]) -> None:
        """Have a call made in turn; of those with the same slot the latest counts."""

    def later(self, delay_s: float, call: Callable[[], None]) -> None:
        """Have a call made after so many simulated seconds."""


class HeardTopic:
    """A topic of ROS 2 that is heard.

    Args:
        host: the gateway.
        link: which, and what becomes of it.
        topic: of the system.
        beside: topic of the system that is read beside; None for none.
    """

    def __init__(self, host: Host, link: Ros2Link, topic: Topic[Any],
                 beside: Topic[Any] | None = None) -> None:
        types = host.node.types
        self._host, self._link, self._topic = host, link, topic
        self._decode = types.decoder(link.type)
        self._made = Inward(link, types, topic.type, beside.type if beside else None)
        self._period_s = 1 / link.rate_hz * _ROUNDING if link.rate_hz else 0.0
        self._passed_s = -math.inf
        self._who = b""
        self._who_s = -math.inf
        self._number = 0
        self._is_known = False  # in the graph, where its end would be seen
        self._slot = None if topic.qos is BusQos.COMMAND else f"ros2 {link.name}"
        self.declared = host.node.subscribe(
            link.name, link.type, Qos(link.reliable, link.transient_local, depth=link.depth),
            self._arrived)

    def _arrived(self, payload: bytes, attachment: Attachment) -> None:
        self._host.handle(self._slot, partial(self._pass_on, payload, attachment))

    def _pass_on(self, payload: bytes, attachment: Attachment) -> None:
        host, link, now_s = self._host, self._link, self._host.now_s()
        try:
            if not self._is_heard(attachment, now_s):
                return
            if now_s - self._passed_s < self._period_s:
                return
            body, stamp_ns = self._made(self._decode(payload), self._beside(now_s))
            stamp_s = (None if stamp_ns is None or link.stamp == "arrival"
                       else host.time.at_s(stamp_ns))
        except NotMeantError:
            return
        except ValueError as error:
            host.refuse(link.name, str(error))
            return
        self._passed_s = now_s
        host.say(self._topic, body, stamp_s)

    def _beside(self, now_s: float) -> Any:
        """Return the message that is read beside.

        Raises:
            ValueError: it has not come, or is too old.
        """
        link = self._link
        if not link.beside:
            return None
        newest = self._host.newest(link.beside)
        if newest is None or now_s - newest[1] > link.max_age_s:
            raise ValueError(f"no message of {link.beside}, which is read beside, in the last "
                             f"{link.max_age_s:g} s")
        return newest[0]

    def _is_heard(self, attachment: Attachment, now_s: float) -> bool:
        """Whether a message is of the publisher that is heard, and was not heard already.

        Raises:
            ValueError: it is of a second one.
        """
        who, graph = attachment.gid, self._host.graph
        if who != self._who:
            is_gone = self._is_known and graph.who(self._who) is None
            if (self._link.publishers == "one" and now_s - self._who_s < HEARD_LATELY_S
                    and not is_gone):
                raise ValueError(f"two publishers, {self._named(self._who)} and "
                                 f"{self._named(who)}; only the first is heard")
            self._who, self._number, self._is_known = who, 0, False
        elif 0 < attachment.sequence <= self._number:
            return False
        self._number = attachment.sequence
        self._who_s = now_s
        self._is_known = self._is_known or graph.who(who) is not None
        return True

    def _named(self, gid: bytes) -> str:
        found = self._host.graph.who(gid)
        return found.full_name if found else f"one without a token ({gid.hex()[:8]}…)"


class SaidTopic:
    """A topic of ROS 2 on which the gateway publishes.

    Args:
        host: the gateway.
        link: which, and what of.
        topic: of the system.
    """

    def __init__(self, host: Host, link: Ros2Link, topic: Topic[Any]) -> None:
        types = host.node.types
        self._host, self._link = host, link
        self._made = Outward(link, types, topic.type)
        self._period_s = 1 / link.rate_hz * _ROUNDING if link.rate_hz else 0.0
        self._passed_s = -math.inf
        self._zeros = _ZEROS  # nothing was said yet that zeros would take back
        self._publish = host.node.publisher(
            link.name, link.type, Qos(link.reliable, link.transient_local, depth=link.depth))
        if link.stop_after_s is not None:
            self._look()

    def heard(self, message: Any, header: Header) -> None:
        """Say what the system says, if it is young enough and makes sense."""
        host, link, now_s = self._host, self._link, self._host.now_s()
        if now_s - self._passed_s < self._period_s:
            return
        age_s = now_s - header.stamp
        if age_s > link.max_age_s:
            host.refuse(link.name, f"what {header.source} says is {age_s:.3g} s old; at most "
                                   f"{link.max_age_s:g} s are said (max_age_s)")
            return
        if not host.time.is_known:
            host.refuse(link.name, "clock = 'ros', and no message has come on /clock")
            return
        try:
            payload = self._made(message, host.time.stamp_ns(header.stamp), header)
        except (ValueError, TypeError, OverflowError) as error:
            host.refuse(link.name, f"what {header.source} says: {error}")
            return
        self._passed_s, self._zeros = now_s, 0
        self._publish(payload)

    def _look(self) -> None:
        """Say zeros when the system has been silent for too long."""
        within_s = self._link.stop_after_s or math.inf
        now_s = self._host.now_s()
        if self._zeros < _ZEROS and now_s - self._passed_s >= within_s:
            self._zeros += 1
            self._publish(self._made.zero(self._host.time.stamp_ns(now_s)))
        self._host.later(within_s / 2, self._look)
