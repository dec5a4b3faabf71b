"""DM9: command calculation error, by comparison of Osmosis Control with its hot standby."""

from __future__ import annotations

from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.command_comparison import CommandComparison, ComparisonLimits
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeNames

_FIRST_PAIR_S = 0.3
"""A respawned module waits this long for two commands before it says idle."""

class CommandDisagreement(DetectionModule):
    """Active while the two computers of the command disagree; names the life to be respawned."""

    class Parameters(DetectionModule.Parameters, ComparisonLimits, frozen=True):
        """Whom it compares; what it lets pass as of `ComparisonLimits`.

        Attributes:
            suspects: names of the two nodes in the order in which they are accused; by default
                the standby first, whose restart costs nothing.
        """

        suspects: NodeNames = ("standby_control", "osmosis_control")

        def __post_init__(self) -> None:
            """Check what a type cannot say."""
            if not len(set(self.suspects)) == len(self.suspects) == 2 \
                    or "osmosis_control" not in self.suspects:
                raise ValueError("suspects: expected osmosis_control and its standby")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        first, second = self.parameters.suspects
        self._standby = second if first == "osmosis_control" else first
        self.monitor = self.judged_by(CommandComparison(
            (first, second), self.parameters, self.known_after_s(_FIRST_PAIR_S)))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, header: Header) -> None:
        """Hear the active one."""
        self._heard("osmosis_control", message, header)

    @on(topics.STANDBY_COMMAND)
    def standby(self, message: m.Twist, header: Header) -> None:
        """Hear the standby."""
        self._heard(self._standby, message, header)

    def _heard(self, source: str, message: m.Twist, header: Header) -> None:
        self.monitor.heard(source, (message.linear_mps, message.angular_radps), header.stamp,
                           header.incarnation, self.clock.now())
        self.follow()
