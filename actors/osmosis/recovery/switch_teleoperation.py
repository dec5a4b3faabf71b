"""RM5: switch to teleoperation (paper, table II)."""

from __future__ import annotations

from rampart.actors.osmosis.messages import PilotMode
from rampart.actors.osmosis.recovery.controlled_stop import PilotRecovery


class SwitchTeleoperation(PilotRecovery):
    """The Safety Pilot executes the joystick only. A stop is stricter and fulfils this too."""

    mode = PilotMode.TELEOPERATION
    confirming = (PilotMode.TELEOPERATION, PilotMode.STOP)
