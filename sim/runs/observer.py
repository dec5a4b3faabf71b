"""The observer: an actor of the launcher that passes messages to judge, report and console.

It controls nothing. Each receiver is a sink: a function of topic, message and header, called on the
observer's loop in order of arrival. A robot with further topics for its report derives an observer,
which its application names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Injection
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.runtime.actor import BASE_INPUTS, Actor, Context, Header, on
from rampart.actors.runtime.parameters import TopicsHeard
from rampart.actors.system.members import application_class, import_class
from rampart.manager.spec.schema import SystemSpec

Sink = Callable[[Topic[Any], Any, Header], None]


class Observer(Actor):
    """Passes all its messages to its sinks."""

    class Parameters(Actor.Parameters, frozen=True):
        """Further inputs.

        Attributes:
            judged: Keys of the judge's topics.
        """

        judged: TopicsHeard = ()

    parameters: Parameters

    def __init__(self, context: Context, sinks: Sequence[Sink] = ()) -> None:
        super().__init__(context)
        self._sinks = tuple(sinks)
        for key in self.parameters.judged:
            self.hear_topic(key, partial(self._pass_on, self.chosen_topic(key)))
        self._topic_of = {topic.type: topic for topic in self.inputs()
                          if topic not in BASE_INPUTS}

    @on(ftm_topics.DETECTION)
    @on(ftm_topics.RECOVERY)
    @on(ftm_topics.DECISION)
    @on(ftm_topics.SHADOW)
    @on(ftm_topics.MANAGER_STATUS)
    @on(ftm_topics.NODES)
    @on(ftm_topics.PROCESS_EVENT)
    @on(bus_topics.INJECTION_REPORT)
    @on(bus_topics.DIAGNOSTIC)
    def heard(self, message: Any, header: Header) -> None:
        """Pass one message on."""
        # Each of these topics has a different type.
        self._pass_on(self._topic_of[type(message)], message, header)

    @on(bus_topics.INJECT)
    def _on_injection(self, order: Injection, header: Header) -> None:
        self._pass_on(bus_topics.INJECT, order, header)  # an observer publishes nothing to disturb

    def _pass_on(self, topic: Topic[Any], message: Any, header: Header) -> None:
        for sink in self._sinks:
            sink(topic, message, header)


def observer_class(spec: SystemSpec) -> type[Observer]:
    """Return the observer of a system's runs.

    Raises:
        ValueError: The application or its observer does not exist.
    """
    return import_class(application_class(spec).observer, Observer, "observer")
