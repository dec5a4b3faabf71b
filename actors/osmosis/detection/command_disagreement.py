"""DM9: command calculation error, by comparison of Osmosis Control with its hot standby."""

from __future__ import annotations

from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.command_comparison import CommandComparison, ComparisonLimits
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import amount

_FIRST_PAIR_S = 0.3
"""A respawned module waits this long for two commands before it says idle."""


class CommandDisagreement(DetectionModule):
    """Active while the two computers of the command disagree; names the life to be respawned.

    Parameters:
        suspects: names of the two nodes in the order in which they are accused; by default the
            standby first, whose restart costs nothing.
        linear_mps, angular_radps: differences that are none.
        linear_s, angular_s: how long each may last.
        hold_s: how long they must have agreed again before the module is idle, s.
    """

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        names = self.parameters.get("suspects", ("standby_control", "osmosis_control"))
        if isinstance(names, str) or len(names) != 2 or "osmosis_control" not in names:
            raise ValueError(f"parameters.suspects = {names!r}: must name osmosis_control and "
                             "its standby")
        first, second = map(str, names)
        self._standby = second if first == "osmosis_control" else first
        usual = ComparisonLimits()
        self.monitor = self.judged_by(CommandComparison(
            (first, second),
            ComparisonLimits(**{
                name: amount(self.parameters, name, getattr(usual, name))
                for name in ("linear_mps", "angular_radps", "linear_s", "angular_s", "hold_s")}),
            self.known_after_s(_FIRST_PAIR_S)))

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
