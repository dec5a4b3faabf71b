"""Topics, services and actions that the gateway passes on between ROS 2 and the system."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import msgspec

from rampart.actors.bus.bounds import Count, Text, clip
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos as BusQos
from rampart.actors.bus.topic import Topic
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.ros_clock import RosClock
from rampart.actors.ros2.translation.mapping import Inward, NotMeantError, Outward, message_of
from rampart.actors.ros2.translation.tables import Ros2Link
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import UNKNOWN_GID, Attachment, Qos, RosGraph
from rampart.actors.runtime.clock import Clock

SILENT_S = 1.0
"""A publisher that is silent for so many simulated seconds may be replaced by another one."""

_MISSED = 3
"""A publisher that has missed so many messages in a row is probably gone."""

_ROUNDING = 0.999

_ZEROS = 20
"""Messages of zeros that are published after the system has fallen silent."""

_REQUEST, _RESPONSE = "_Request", "_Response"
_GOAL, _SEND, _GET = "_Goal", "_SendGoal", "_GetResult"

ENDS = {4: "succeeded", 5: "cancelled", 6: "aborted"}
"""Status of a goal that has ended (action_msgs/msg/GoalStatus)."""

_RESULT_WITHIN_S = 86_400.0


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




class GoalState(Message, frozen=True):
    """State of an action's goal.

    `phase`: "sent", "accepted", "rejected", "succeeded", "cancelled", "aborted", or "unanswered".
    `number` counts the goals that the gateway has sent.
    """

    number: Count
    phase: Text
    why: Text = ""


def request_topic(link: Ros2Link, types: Types) -> Topic[Any]:
    """Return the topic of a link's requests or goals, for a system that does not declare it.

    Raises:
        ValueError: the type is not known.
    """
    part = _GOAL if link.way == "goal" else _REQUEST
    made = message_of(msgspec.structs.replace(_part(link, part), fields={}), types)
    return Topic(link.from_, made, BusQos.COMMAND, 0.0, "",
                 f"Requests to {link.name} of ROS 2, {link.type}.")


def answer_topic(link: Ros2Link, types: Types) -> Topic[Any]:
    """Return the topic of a link's answers, for a system that does not declare it.

    Raises:
        ValueError: the type is not known.
    """
    if link.way == "goal":
        made: type[msgspec.Struct] = GoalState
    else:
        response = message_of(_part(link, _RESPONSE, link.answer), types)
        made = msgspec.defstruct(
            "Answer", [("done", bool), ("why", Text, ""), *(
                (f.name, f.type | None, None) for f in msgspec.structs.fields(response))],
            bases=(Message,), frozen=True)
    return Topic(link.to, made, BusQos.COMMAND, 0.0, "",
                 f"Answers of {link.name} of ROS 2, {link.type}.")


def _part(link: Ros2Link, part: str, fields: Mapping[str, Any] | None = None) -> Ros2Link:
    """Return a link to a part of its type, e.g. the request of a service."""
    return msgspec.structs.replace(
        link, type=f"{link.type}{part}", fields=link.fields if fields is None else fields)


def _encoded(translate: Outward, message: Any, header: Header, link: Ros2Link, gateway: Gateway
             ) -> bytes:
    """Return an encoded request or goal.

    Raises:
        ValueError: it is out of date, e.g. after a stop of the gateway, or cannot be translated.
    """
    try:
        age_s, most_s = gateway.clock.now() - header.stamp, max(link.max_age_s, link.within_s)
        if age_s > most_s:
            raise ValueError(f"{age_s:.3g} s old; expected at most {most_s:g} s")
        return translate(message, gateway.time.stamp_ns(header.stamp), header)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"request of {header.source}: {error}") from None


class ServiceCall:
    """Calls a service of ROS 2 with each message of a topic of the system.

    Args:
        gateway: that calls.
        link: row of the specification.
        asks: topic of the requests.
        answers: topic of the answers; it has a field `done`, and may have `why`.
    """

    def __init__(self, gateway: Gateway, link: Ros2Link, asks: Topic[Any], answers: Topic[Any]
                 ) -> None:
        types = gateway.node.types
        self._gateway, self._link, self._answers = gateway, link, answers
        self._request = Outward(_part(link, _REQUEST), types, asks.type, lenient=True)
        self._response = _Response(link, types, answers.type)
        self._ask = gateway.node.client(link.name, link.type)
        self._is_under_way = False

    def take(self, message: Any, header: Header) -> None:
        """Call the service, unless a call is under way: the system repeats its requests."""
        if self._is_under_way:
            return
        try:
            payload = _encoded(self._request, message, header, self._link, self._gateway)
        except ValueError as error:
            self._publish(None, str(error))
            return
        self._is_under_way = True
        self._ask(payload, self._link.within_s, lambda answer, why: self._gateway.enqueue(
            None, partial(self._answered, answer, why)))

    def _answered(self, answer: bytes | None, why: str) -> None:
        self._is_under_way = False
        self._publish(answer, why)

    def _publish(self, answer: bytes | None, why: str) -> None:
        try:
            body = self._response(answer, why)
        except ValueError as error:
            self._gateway.refuse(self._link.name, str(error))
            body = self._response(None, str(error))
        self._gateway.emit(self._answers, body, None)


class _Response:
    """Translates the response of a service into a message of the system."""

    def __init__(self, link: Ros2Link, types: Types, made: type[msgspec.Struct]) -> None:
        known = {f.name for f in msgspec.structs.fields(made)}
        if "done" not in known:
            raise ValueError(f"to: {made.__name__} has no field 'done'; expected one that is true "
                             "when the service has answered")
        self._made, self._has_why = made, "why" in known
        self._decode = types.decoder(f"{link.type}{_RESPONSE}")
        given: dict[str, Any] = {"done": True, **({"why": "''"} if self._has_why else {})}
        self._translate = Inward(msgspec.structs.replace(
            _part(link, _RESPONSE, {**link.answer, **given}), frame=""), types, made)

    def __call__(self, answer: bytes | None, why: str) -> msgspec.Struct:
        """Return the message; raises ValueError if the answer is not such a response."""
        if answer is None:
            words = {"why": clip(why)} if self._has_why else {}
            return msgspec.convert({"done": False, **words}, self._made)
        return self._translate(self._decode(answer))[0]


class ActionCall:
    """Sends each message of a topic of the system as a goal to an action; a new goal replaces it.

    Args:
        gateway: that sends.
        link: row of the specification.
        asks: topic of the goals.
        answers: topic of `GoalState`.
    """

    def __init__(self, gateway: Gateway, link: Ros2Link, asks: Topic[Any], answers: Topic[Any]
                 ) -> None:
        self._gateway, self._link, self._answers = gateway, link, answers
        self._types = gateway.node.types
        self._goal = Outward(_part(link, _GOAL), self._types, asks.type, lenient=True)
        where = f"{link.name}/_action"
        self._send = gateway.node.client(f"{where}/send_goal", f"{link.type}{_SEND}")
        self._get = gateway.node.client(f"{where}/get_result", f"{link.type}{_GET}")
        self._number = 0

    def take(self, message: Any, header: Header) -> None:
        """Send a goal."""
        gateway, types, kind = self._gateway, self._types, self._link.type
        self._number += 1
        number = self._number
        try:
            goal = types.decode(f"{kind}{_GOAL}", _encoded(
                self._goal, message, header, self._link, gateway))
        except ValueError as error:
            self._publish(number, "rejected", str(error))
            return
        request = types.blank(f"{kind}{_SEND}{_REQUEST}")
        request.goal = goal
        request.goal_id.uuid[:] = list(os.urandom(16))
        self._publish(number, "sent")
        self._send(types.encode(f"{kind}{_SEND}{_REQUEST}", request), self._link.within_s,
                   lambda answer, why: gateway.enqueue(None, partial(
                       self._sent, number, request.goal_id, answer, why)))

    def _sent(self, number: int, goal_id: Any, answer: bytes | None, why: str) -> None:
        kind = self._link.type
        try:
            is_accepted = answer is not None and self._types.decode(
                f"{kind}{_SEND}{_RESPONSE}", answer).accepted
        except ValueError as error:
            answer, why, is_accepted = None, str(error), False
        if not is_accepted:
            self._publish(number, "unanswered" if answer is None else "rejected", why)
            return
        self._publish(number, "accepted")
        request = self._types.blank(f"{kind}{_GET}{_REQUEST}")
        request.goal_id = goal_id
        self._get(self._types.encode(f"{kind}{_GET}{_REQUEST}", request), _RESULT_WITHIN_S,
                  lambda answer, why: self._gateway.enqueue(None, partial(
                      self._ended, number, answer, why)))

    def _ended(self, number: int, answer: bytes | None, why: str) -> None:
        try:
            if answer is None:
                raise ValueError(why)
            status = self._types.decode(f"{self._link.type}{_GET}{_RESPONSE}", answer).status
            self._publish(number, ENDS.get(int(status), "aborted"))
        except ValueError as error:
            self._publish(number, "unanswered", str(error))

    def _publish(self, number: int, phase: str, why: str = "") -> None:
        if number == self._number:  # a goal that was replaced is not reported any more
            self._gateway.emit(self._answers, GoalState(number, phase, clip(why)), None)


def check_call(link: Ros2Link, types: Types, asks: Any, answers: Any) -> None:
    """Refuse a call or action that cannot be translated.

    Args:
        link: row of the specification.
        types: of ROS 2.
        asks: type of the messages of `from`.
        answers: type of the messages of `to`.

    Raises:
        ValueError: a type or field does not exist.
    """
    if link.way == "goal":
        Outward(_part(link, _GOAL), types, asks, lenient=True)
        types.hash(f"{link.type}{_SEND}")
    else:
        Outward(_part(link, _REQUEST), types, asks, lenient=True)
        _Response(link, types, answers)
        types.hash(link.type)
