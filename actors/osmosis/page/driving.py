"""Driving Osmosis from its page: whether the joystick has an effect, and why not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rampart.actors.bus import messages as bm
from rampart.actors.ftm import messages as fm
from rampart.actors.operator.operating import Operating
from rampart.actors.operator.panels import Panel
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics

if TYPE_CHECKING:
    from rampart.actors.operator.state import HmiState
    from rampart.actors.runtime.actor import Actor

_STALE_S = 1.5
"""Simulated seconds after which the Safety Pilot is silent, but at least half a real one."""

_DRIVEN_BY = ("teleoperation", "safety_pilot")
"""Nodes between the page's joystick and the base."""


class Driving(Operating):
    """The operator's controls, and the effect of the joystick.

    Args:
        actor: the page's node.
        state: state of the pages; this class writes the section "operating".
        panels: panels of the page.
    """

    def __init__(self, actor: Actor, state: HmiState, panels: Sequence[Panel]) -> None:
        self._pilot: m.PilotStatus | None = None
        self._pilot_s = -math.inf
        self._brake = False
        self._dead: tuple[str, ...] = ()
        self._driven_by = tuple(p.title for p in panels if p.topic == topics.JOYSTICK.key)
        super().__init__(actor, state, panels)

    def pilot(self, message: m.PilotStatus) -> None:
        """Take the status of the Safety Pilot."""
        before, self._pilot, self._pilot_s = self._pilot, message, self._now()
        if before != message:
            self.show()

    def base(self, message: m.BaseStatus) -> None:
        """Take the state of the brake."""
        if message.brake_engaged != self._brake:
            self._brake = message.brake_engaged
            self.show()

    def nodes(self, table: fm.NodeTable) -> None:
        """Take the table of nodes: whether those between joystick and base run."""
        super().nodes(table)
        running = {row.name for row in table.nodes if row.state is fm.NodeState.RUNNING}
        dead = tuple(name for name in _DRIVEN_BY if name not in running)
        if dead != self._dead:
            self._dead = dead
            self.show()

    def diagnostic(self, report: bm.Diagnostic) -> None:
        """Take why Teleoperation ignores this joystick, e.g. because another one drives."""
        if (report.node == _DRIVEN_BY[0] and report.offender == self._actor.name
                and report.context == "joystick"):
            for panel in self._driven_by:
                self._sticks[panel].note = f"Teleoperation: {report.reason}"
            self.show()

    def effect(self, panel: str, now_s: float) -> tuple[bool, str]:
        """Return whether a panel's joystick has an effect now, and a text that explains it."""
        if panel not in self._driven_by:
            return super().effect(panel, now_s)
        pilot = self._pilot
        patience_s = max(_STALE_S, 0.5 * self._actor.clock.rate)
        return effect(
            pilot_heard=now_s - self._pilot_s <= patience_s, mode=pilot.mode if pilot else "",
            forbids=pilot.forbids if pilot else "", brake=self._brake, dead_nodes=self._dead)


def effect(*, pilot_heard: bool, mode: str, forbids: str, brake: bool, dead_nodes: tuple[str, ...]
           ) -> tuple[bool, str]:
    """Return whether the joystick has an effect now, and a text that explains it.

    Args:
        pilot_heard: whether the Safety Pilot's status is fresh.
        mode: mode of the Safety Pilot.
        forbids: why it forbids driving, or "".
        brake: whether the base's brake is engaged.
        dead_nodes: nodes between joystick and base that do not run.
    """
    for is_so, why in ((dead_nodes, f"{', '.join(dead_nodes)} does not run"),
                       (not pilot_heard, "the Safety Pilot is silent"),
                       (brake, "the brake is engaged (emergency stop)"),
                       (forbids, forbids)):
        if is_so:
            return False, f"no effect: {why}"
    if mode == "teleoperation":
        return True, "the robot obeys only the joystick; it stands while you release it"
    return True, "the joystick overrides the mission while you hold it"
