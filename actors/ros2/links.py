"""Topics that the gateway passes on between ROS 2 and the system."""

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
from rampart.actors.ros2.wire import UNKNOWN_GID, Attachment, Qos
from rampart.actors.runtime.clock import Clock

SILENT_S = 1.0
"""A publisher that is silent for so many simulated seconds may be replaced by another one."""

_MISSED = 3
"""A publisher that has missed so many messages in a row is probably gone."""

_ROUNDING = 0.999

_ZEROS = 20
"""Messages of zeros that are published after the system has fallen silent."""


class Gateway(Protocol):
    """The gateway as its links use it; `gateway.Gateway` describes the members."""

    node: RosNode
    graph: RosGraph
    time: RosClock
    clock: Clock

    def newest(self, key: str) -> tuple[msgspec.Struct, float] | None:
        """Return the newest message on a topic of `beside`, and its stamp."""

    def emit(self, topic: Topic[Any], body: msgspec.Struct, stamp_s: float | None) -> None:
        """Publish a message to the system."""

    def refuse(self, where: str, why: str) -> None:
        """Report and count a message that is not passed on."""

    def enqueue(self, slot: str | None, call: Callable[[], None]) -> None:
        """Put a call into the mailbox."""

    def call_later(self, delay_s: float, call: Callable[[], None]) -> object:
        """Call a function after simulated seconds."""


class Subscription:
    """Publishes the messages of a topic of ROS 2 on a topic of the system.

    Args:
        gateway: that subscribes.
        link: row of the specification.
        topic: of the system.
        beside: topic of the system whose newest message the translation reads too.
    """

    def __init__(self, gateway: Gateway, link: Ros2Link, topic: Topic[Any],
                 beside: Topic[Any] | None = None) -> None:
        types = gateway.node.types
        self._gateway, self._link, self._topic = gateway, link, topic
        self._decode = types.decoder(link.type)
        self._translate = Inward(link, types, topic.type, beside.type if beside else None)
        self._period_s = 1 / link.rate_hz * _ROUNDING if link.rate_hz else 0.0
        self._passed_s = -math.inf
        self._publisher = b""
        self._published_s = -math.inf
        self._gap_s = math.inf  # between the publisher's last two messages
        self._sequence = 0
        self._is_in_graph = False  # only then the graph shows that the publisher ends
        self._slot = None if topic.qos is BusQos.COMMAND else f"ros2 {link.name}"
        gateway.node.subscribe(
            link.name, link.type, Qos(link.reliable, link.transient_local, depth=link.depth),
            self._arrived)

    @property
    def has_received(self) -> bool:
        """Whether a message of its publisher has come."""
        return self._published_s > -math.inf

    def _arrived(self, payload: bytes, attachment: Attachment) -> None:
        self._gateway.enqueue(self._slot, partial(self._pass_on, payload, attachment))

    def _pass_on(self, payload: bytes, attachment: Attachment) -> None:
        gateway, link, now_s = self._gateway, self._link, self._gateway.clock.now()
        try:
            if not self._is_new(attachment, now_s):
                return
            if now_s - self._passed_s < self._period_s:
                return
            body, stamp_ns = self._translate(self._decode(payload), self._beside(now_s))
            stamp_s = (None if stamp_ns is None or link.stamp == "arrival"
                       else gateway.time.at_s(stamp_ns))
        except NotMeantError:
            return
        except ValueError as error:
            gateway.refuse(link.name, str(error))
            return
        self._passed_s = now_s
        gateway.emit(self._topic, body, stamp_s)

    def _beside(self, now_s: float) -> Any:
        """Return the message of `beside`; raises ValueError if none has come lately."""
        link = self._link
        if not link.beside:
            return None
        newest = self._gateway.newest(link.beside)
        if newest is None or now_s - newest[1] > link.max_age_s:
            raise ValueError(f"beside: no message of {link.beside} in the last "
                             f"{link.max_age_s:g} s")
        return newest[0]

    def _is_new(self, attachment: Attachment, now_s: float) -> bool:
        """Return whether a message is new; raises ValueError if its publisher is refused."""
        gid, graph = attachment.gid, self._gateway.graph
        if gid == UNKNOWN_GID and self._link.publishers == "one":
            raise ValueError("several publishers, which this ROS 2 does not tell apart; none is "
                             "passed on; a killed one counts until its lease ends")
        if gid != self._publisher:
            expected, name = self._link.publisher, self._name_of(gid)
            if expected and name != expected:
                raise ValueError(f"published by {name}; expected {expected}")
            has_left = self._is_in_graph and graph.endpoint(self._publisher) is None
            if (self._link.publishers == "one" and now_s - self._published_s < SILENT_S
                    and not has_left):
                is_silent = now_s - self._published_s > _MISSED * self._gap_s
                raise ValueError(
                    f"two publishers, {self._name_of(self._publisher)} and {name}; " + (
                        "the first one is silent, probably a killed one, which is in the graph "
                        f"until its lease ends; the other is passed on after {SILENT_S:g} s"
                        if is_silent else "only the first one is passed on"))
            self._publisher, self._sequence, self._is_in_graph = gid, 0, False
        elif 0 < attachment.sequence <= self._sequence:
            return False
        self._sequence = attachment.sequence
        self._gap_s, self._published_s = now_s - self._published_s, now_s
        self._is_in_graph = self._is_in_graph or graph.endpoint(gid) is not None
        return True

    def _name_of(self, gid: bytes) -> str:
        found = self._gateway.graph.endpoint(gid)
        return found.full_name if found else f"a publisher without a token ({gid.hex()[:8]}…)"


class Publication:
    """Publishes the messages of a topic of the system on a topic of ROS 2.

    Args:
        gateway: that publishes.
        link: row of the specification.
        topic: of the system.
    """

    def __init__(self, gateway: Gateway, link: Ros2Link, topic: Topic[Any]) -> None:
        self._gateway, self._link = gateway, link
        self._translate = Outward(link, gateway.node.types, topic.type)
        self._period_s = 1 / link.rate_hz * _ROUNDING if link.rate_hz else 0.0
        self._passed_s = -math.inf
        self._zeros = _ZEROS  # nothing has been published yet that zeros would cancel
        self._publish = gateway.node.publisher(
            link.name, link.type, Qos(link.reliable, link.transient_local, depth=link.depth))
        if link.stop_after_s is not None:
            self._stop_if_silent()

    def take(self, message: Any, header: Header) -> None:
        """Publish a message of the system, unless it is too old or cannot be translated."""
        gateway, link, now_s = self._gateway, self._link, self._gateway.clock.now()
        if now_s - self._passed_s < self._period_s:
            return
        age_s = now_s - header.stamp
        if age_s > link.max_age_s:
            gateway.refuse(link.name, f"message of {header.source} is {age_s:.3g} s old; expected "
                                      f"at most max_age_s = {link.max_age_s:g} s")
            return
        if not gateway.time.is_known:
            gateway.refuse(link.name, "clock = 'ros', and no message has come on /clock")
            return
        try:
            payload = self._translate(message, gateway.time.stamp_ns(header.stamp), header)
        except (ValueError, TypeError, OverflowError) as error:
            gateway.refuse(link.name, f"message of {header.source}: {error}")
            return
        self._passed_s, self._zeros = now_s, 0
        self._publish(payload)

    def end(self) -> None:
        """Publish a last message of zeros, if zeros are configured and have not come already."""
        if self._link.stop_after_s is not None and self._zeros < _ZEROS:
            self._publish_zeros()

    def _publish_zeros(self) -> None:
        gateway = self._gateway
        self._publish(self._translate.zero(gateway.time.stamp_ns(gateway.clock.now())))

    def _stop_if_silent(self) -> None:
        silence_s = self._link.stop_after_s or math.inf
        now_s = self._gateway.clock.now()
        if self._zeros < _ZEROS and now_s - self._passed_s >= silence_s:
            self._zeros += 1
            self._publish_zeros()
        self._gateway.call_later(silence_s / 2, self._stop_if_silent)
