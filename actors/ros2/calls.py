"""Services and actions of ROS 2 that are called, and services that are offered."""

from __future__ import annotations

import os
from functools import partial
from typing import Any

import msgspec

from rampart.actors.bus.bounds import Count, Text, clip
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.ros2.links import Host
from rampart.actors.ros2.translation.mapping import Inward, Outward
from rampart.actors.ros2.translation.mirror import message_of
from rampart.actors.ros2.translation.tables import Ros2Link
from rampart.actors.ros2.translation.types import Types

CANCEL = "action_msgs/srv/CancelGoal"
_REQUEST, _RESPONSE = "_Request", "_Response"
_GOAL, _RESULT, _SEND, _GET = "_Goal", "_Result", "_SendGoal", "_GetResult"

ENDS = {4: "succeeded", 5: "cancelled", 6: "aborted"}
"""Status of a goal that has ended (action_msgs/msg/GoalStatus)."""

_RESULT_WITHIN_S = 86_400.0


class GoalState(Message, frozen=True):
    """How the goal of an action goes.

    `phase`: "sent", "accepted", "rejected", "succeeded", "cancelled", "aborted", or "unanswered".
    `number` counts the goals that the gateway has sent.
    """

    number: Count
    phase: Text
    why: Text = ""


def request_topic(link: Ros2Link, types: Types) -> Topic[Any]:
    """Return the topic of the requests or goals of a link, if nobody else declares it.

    Raises:
        ValueError: the type is not known.
    """
    part = _GOAL if link.way == "goal" else _REQUEST
    made = message_of(msgspec.structs.replace(
        link, type=f"{link.type}{part}", fields={}), types)
    return Topic(link.from_, made, Qos.COMMAND, 0.0, "", f"What {link.name} of ROS 2 is asked, "
                 f"{link.type}.")


def answer_topic(link: Ros2Link, types: Types) -> Topic[Any]:
    """Return the topic of the answers, likewise; arguments and errors as of `request_topic`."""
    if link.way == "goal":
        made: type[msgspec.Struct] = GoalState
    elif link.way == "serve":
        made = message_of(msgspec.structs.replace(link, type=f"{link.type}{_REQUEST}"), types)
    else:
        response = message_of(msgspec.structs.replace(
            link, type=f"{link.type}{_RESPONSE}", fields=link.answer), types)
        made = msgspec.defstruct(
            "Answer", [("done", bool), ("why", Text, ""), *(
                (f.name, f.type | None, None) for f in msgspec.structs.fields(response))],
            bases=(Message,), frozen=True)
    what = "is asked" if link.way == "serve" else "answers"
    return Topic(link.to, made, Qos.COMMAND, 0.0, "", f"What {link.name} of ROS 2 {what}, "
                 f"{link.type}.")


class Called:
    """A service of ROS 2 that is called.

    Args:
        host: the gateway.
        link: which.
        asks: topic of the system that has the requests.
        answers: topic of the system for the answers; it has a field `done`, and may have `why`.
    """

    def __init__(self, host: Host, link: Ros2Link, asks: Topic[Any], answers: Topic[Any]) -> None:
        types = host.node.types
        self._host, self._link, self._answers = host, link, answers
        self._request = Outward(msgspec.structs.replace(
            link, type=f"{link.type}{_REQUEST}"), types, asks.type, lenient=True)
        self._response = _ResponseOf(link, types, answers.type)
        self._client = host.node.client(link.name, link.type)
        self._is_under_way = False

    def heard(self, message: Any, header: Header) -> None:
        """Call the service; a request that comes while one is under way comes again."""
        if self._is_under_way:
            return
        if self._host.now_s() - header.stamp > max(self._link.max_age_s, self._link.within_s):
            self._host.refuse(self._link.name, f"what {header.source} asks is too old")
            return
        try:
            payload = self._request(message, self._host.time.stamp_ns(header.stamp), header)
        except (ValueError, TypeError, OverflowError) as error:
            self._say(None, f"what {header.source} asks: {error}")
            return
        self._is_under_way = True
        self._client.ask(payload, self._link.within_s, lambda answer, why: self._host.handle(
            None, partial(self._over, answer, why)))

    def _over(self, answer: bytes | None, why: str) -> None:
        self._is_under_way = False
        self._say(answer, why)

    def _say(self, answer: bytes | None, why: str) -> None:
        try:
            body = self._response(answer, why)
        except ValueError as error:
            self._host.refuse(self._link.name, str(error))
            body = self._response(None, str(error))
        self._host.say(self._answers, body, None)


class _ResponseOf:
    """Makes the message of the system that a response is."""

    def __init__(self, link: Ros2Link, types: Types, made: type[msgspec.Struct]) -> None:
        name = f"{link.type}{_RESPONSE}"
        known = {f.name for f in msgspec.structs.fields(made)}
        if "done" not in known:
            raise ValueError(f"to: {made.__name__} has no field 'done', which says whether an "
                             "answer has come")
        self._made, self._has_why = made, "why" in known
        self._decode = types.decoder(name)
        said: dict[str, Any] = {"done": True, **({"why": "''"} if self._has_why else {})}
        self._inward = Inward(msgspec.structs.replace(
            link, type=name, fields={**link.answer, **said}, frame=""), types, made)

    def __call__(self, answer: bytes | None, why: str) -> msgspec.Struct:
        """Return the message.

        Raises:
            ValueError: it is no such response.
        """
        if answer is None:
            words = {"why": clip(why)} if self._has_why else {}
            return msgspec.convert({"done": False, **words}, self._made)
        return self._inward(self._decode(answer))[0]


class Served:
    """A service that is offered to ROS 2: what it is asked is published, and answered at once.

    Args:
        host: the gateway.
        link: which, and the answer.
        topic: of the system, for the requests.
    """

    def __init__(self, host: Host, link: Ros2Link, topic: Topic[Any]) -> None:
        types, name = host.node.types, f"{link.type}{_REQUEST}"
        self._host, self._topic = host, topic
        self._decode = types.decoder(name)
        self._made = Inward(msgspec.structs.replace(link, type=name), types, topic.type)
        self._answer = response_of(link, types)
        host.node.serve(link.name, link.type, self._asked)

    def _asked(self, payload: bytes) -> bytes:
        body, _ = self._made(self._decode(payload))
        self._host.handle(None, lambda: self._host.say(self._topic, body, None))
        return self._answer


def response_of(link: Ros2Link, types: Types) -> bytes:
    """Return what a service that is offered answers, as it travels.

    Raises:
        ValueError: a field does not exist, or does not take its value.
    """
    name = f"{link.type}{_RESPONSE}"
    blank = types.blank(name)
    known = dict(types.fields(name))
    for field, value in link.answer.items():
        if field not in known:
            raise ValueError(f"answer: {name} has no field {field!r}; known: {', '.join(known)}")
        setattr(blank, field, value)
    return types.encode(name, blank)


class Goal:
    """An action of ROS 2: one goal at a time, of which the last one counts.

    Args:
        host: the gateway.
        link: which.
        asks: topic of the system that has the goals.
        answers: topic of the system that says how they go: of `GoalState`.
    """

    def __init__(self, host: Host, link: Ros2Link, asks: Topic[Any], answers: Topic[Any]) -> None:
        types = host.node.types
        self._host, self._link, self._answers, self._types = host, link, answers, types
        self._goal = Outward(msgspec.structs.replace(
            link, type=f"{link.type}{_GOAL}"), types, asks.type, lenient=True)
        where = f"{link.name}/_action"
        self._send = host.node.client(f"{where}/send_goal", f"{link.type}{_SEND}")
        self._get = host.node.client(f"{where}/get_result", f"{link.type}{_GET}")
        self._number = 0

    def heard(self, message: Any, header: Header) -> None:
        """Send a goal."""
        host, types, kind = self._host, self._types, self._link.type
        self._number += 1
        number = self._number
        try:
            goal = types.decode(f"{kind}{_GOAL}", self._goal(
                message, host.time.stamp_ns(header.stamp), header))
        except (ValueError, TypeError, OverflowError) as error:
            self._say(number, "rejected", f"what {header.source} asks: {error}")
            return
        request = types.blank(f"{kind}{_SEND}{_REQUEST}")
        request.goal = goal
        request.goal_id.uuid[:] = list(os.urandom(16))
        self._say(number, "sent")
        self._send.ask(types.encode(f"{kind}{_SEND}{_REQUEST}", request), self._link.within_s,
                       lambda answer, why: host.handle(None, partial(
                           self._sent, number, request.goal_id, answer, why)))

    def _sent(self, number: int, goal_id: Any, answer: bytes | None, why: str) -> None:
        kind = self._link.type
        try:
            is_accepted = answer is not None and self._types.decode(
                f"{kind}{_SEND}{_RESPONSE}", answer).accepted
        except ValueError as error:
            answer, why, is_accepted = None, str(error), False
        if not is_accepted:
            self._say(number, "unanswered" if answer is None else "rejected", why)
            return
        self._say(number, "accepted")
        request = self._types.blank(f"{kind}{_GET}{_REQUEST}")
        request.goal_id = goal_id
        self._get.ask(self._types.encode(f"{kind}{_GET}{_REQUEST}", request), _RESULT_WITHIN_S,
                      lambda answer, why: self._host.handle(None, partial(
                          self._ended, number, answer, why)))

    def _ended(self, number: int, answer: bytes | None, why: str) -> None:
        try:
            if answer is None:
                raise ValueError(why)
            status = self._types.decode(f"{self._link.type}{_GET}{_RESPONSE}", answer).status
            self._say(number, ENDS.get(int(status), "aborted"))
        except ValueError as error:
            self._say(number, "unanswered", str(error))

    def _say(self, number: int, phase: str, why: str = "") -> None:
        if number == self._number:  # of a goal that another has replaced nothing is said
            self._host.say(self._answers, GoalState(number, phase, clip(why)), None)
