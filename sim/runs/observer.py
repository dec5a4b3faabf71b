"""The observer: lives in the launcher's process and hears what the run's story is made of.

It controls nothing. Whoever wants the story (judge, report, console, launcher) is a sink: a
function of topic, message and header, called on the observer's loop in order of arrival.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import GroundTruth, MissionPhase, MissionStatus
from rampart.actors.runtime.actor import BASE_INPUTS, Actor, Context, Header, on
from rampart.sim.osmosis.judge import Judge, Sample

Sink = Callable[[Topic[Any], Any, Header], None]


class Observer(Actor):
    """Passes everything it hears to its sinks."""

    def __init__(self, context: Context, sinks: Sequence[Sink] = ()) -> None:
        super().__init__(context)
        self._sinks = tuple(sinks)
        self._topic_of = {topic.type: topic for topic in self.inputs()
                          if topic not in BASE_INPUTS}

    @on(topics.MISSION_STATUS)
    @on(topics.CONTROL_STATUS)
    @on(topics.LIGHT_MEASURED)
    @on(topics.POSE)
    @on(topics.PILOT_STATUS)
    @on(ftm_topics.DETECTION)
    @on(ftm_topics.RECOVERY)
    @on(ftm_topics.DECISION)
    @on(ftm_topics.SHADOW)
    @on(ftm_topics.MANAGER_STATUS)
    @on(ftm_topics.NODES)
    @on(ftm_topics.PROCESS_EVENT)
    @on(bus_topics.INJECTION_REPORT)
    @on(bus_topics.DIAGNOSTIC)
    @on(topics.TRUTH)
    @on(topics.OBSTACLES)
    def heard(self, message: Any, header: Header) -> None:
        """Pass one message on."""
        topic = self._topic_of[type(message)]  # each topic heard here has a type of its own
        for sink in self._sinks:
            sink(topic, message, header)


class JudgeSink:
    """Feeds a judge with ground truth and the mode that the mission reports."""

    def __init__(self, judge: Judge) -> None:
        self._judge = judge
        self._mode = ""

    def __call__(self, _topic: Topic[Any], message: Any, header: Header) -> None:
        """Take one message; those that are neither truth nor mission status do not matter."""
        if isinstance(message, MissionStatus):
            running = message.phase is MissionPhase.RUNNING and message.step < len(message.goals)
            self._mode = message.goals[message.step].mode.value if running else ""
        elif isinstance(message, GroundTruth):
            self._judge.see(Sample(
                header.stamp, message.pose.x_m, message.pose.y_m, message.collisions,
                message.prohibited_s, message.obstacle_clearance_m,
                message.prohibited_clearance_m, self._mode))
