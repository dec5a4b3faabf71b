"""DM2 and DM6: command not updated, localization not updated (paper, table I)."""

from __future__ import annotations

from typing import Literal

from rampart.actors.detection.module import DetectionModule, Waiting
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.freshness_monitor import FreshnessMonitor
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import ControlTimeout, NodeNames
from rampart.manager.spec.tables import NonNegative


class Freshness(DetectionModule):
    """Active while a topic is stale. A subclass per topic, so that each hears only its own.

    Class attributes:
        subject: what is stale, for the reason.
    """

    class Parameters(Waiting, frozen=True):
        """What is stale, and who is named then.

        Attributes:
            timeout_s: greatest admissible age of the content, s.
            hold_s: how long it must be fresh again before the module is idle, s.
            suspects: names of nodes to be respawned when it is active, as a rule the one that
                publishes the topic; none by default, as in the paper.
            topic: says again what the class says, for readers of the spec.
        """

        timeout_s: ControlTimeout = 1.0
        hold_s: NonNegative = 0.2
        suspects: NodeNames = ()

    parameters: Parameters
    subject = ""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        if not self.subject:
            raise ValueError(f"{self.name}: actor Freshness hears no topic; name a subclass, "
                             "CommandFreshness or LocalizationFreshness")
        timeout_s = self.parameters.timeout_s
        self.monitor = self.judged_by(FreshnessMonitor(
            self.subject, timeout_s, self.parameters.hold_s, self.clock.now(),
            self.grace_s(timeout_s), known=self.first_life))
        self.monitor.nodes = self._suspects = self.parameters.suspects

    def sample(self, header: Header) -> None:
        """Take note of a sample."""
        monitor = self.monitor
        monitor.heard(header.stamp, self.clock.now())
        if self._suspects and not monitor.active:
            # The life that was last heard is accused: a later one has done nothing yet.
            monitor.nodes = tuple(
                f"{name}#{header.incarnation}" if name == header.source else name
                for name in self._suspects)
        self.follow()


class CommandFreshness(Freshness):
    """DM2: Osmosis Control's command is not updated (0.64 s in the authors' code)."""

    class Parameters(Freshness.Parameters, frozen=True):
        """As of `Freshness`."""

        timeout_s: ControlTimeout = 0.64
        topic: Literal["control/command"] = "control/command"

    subject = "command"

    @on(topics.COMMAND)
    def command(self, _message: m.Twist, header: Header) -> None:
        """Hear a command."""
        self.sample(header)


class LocalizationFreshness(Freshness):
    """DM6: the pose is not updated (1 s in the authors' code)."""

    class Parameters(Freshness.Parameters, frozen=True):
        """As of `Freshness`."""

        topic: Literal["localization/pose"] = "localization/pose"

    subject = "localization"

    @on(topics.POSE)
    def pose(self, _message: m.Pose, header: Header) -> None:
        """Hear a pose."""
        self.sample(header)
