"""What bounds a timeout: the time budget from above, false alarms from below."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from rampart.manager.spec.tables import Timing

PERIODS_TO_MISS = 3
"""A timeout shorter than so many periods would take a late message for a lost one."""


class Budget(msgspec.Struct, frozen=True):
    """The two sides of the inequality, for one mechanism or guard; all times in seconds."""

    name: str
    hazard: str
    time_left_s: float
    detection_s: float
    arbitration_s: float
    actuation_s: float
    respawn_s: float = 0.0

    @property
    def needed_s(self) -> float:
        """From the error to the recovery being effective."""
        return self.detection_s + self.arbitration_s + self.actuation_s + self.respawn_s

    @property
    def margin_s(self) -> float:
        """What is left over; negative if the recovery comes too late."""
        return self.time_left_s - self.needed_s

    @property
    def fits(self) -> bool:
        """Whether the recovery starts in time."""
        return self.margin_s >= -1e-9  # the sum of floats may exceed an equal bound by a rounding

    def __str__(self) -> str:
        respawn = f" + respawn {self.respawn_s:.3f}" if self.respawn_s else ""
        return (f"{self.name} needs {self.needed_s:.3f} s (detection {self.detection_s:.3f} + "
                f"arbitration {self.arbitration_s:.3f} + actuation {self.actuation_s:.3f}"
                f"{respawn}) of {self.time_left_s:.3f} s before {self.hazard}")


def find_false_alarms(timing: Timing) -> Iterator[tuple[str, float, str]]:
    """Find timeouts so tight that a healthy system trips them.

    Yields:
        Path in the spec, value, and what is wrong with it.
    """
    for field, period_field in (
            ("heartbeat_timeout_s", "heartbeat_period_s"),
            ("command_timeout_s", "control_period_s"),
            ("localization_timeout_s", "control_period_s"),
            ("scan_timeout_s", "control_period_s"),
            ("dead_man_timeout_s", "control_period_s"),
            ("manager_timeout_s", "manager_period_s"),
            ("detection_silence_timeout_s", "detection_period_s")):
        value = getattr(timing, field)
        problem = find_false_alarm(timing, value, period_field)
        if problem:
            yield f"$.timing.{field}", value, problem


def find_false_alarm(timing: Timing, timeout_s: float, period_field: str) -> str:
    """Say what is wrong with a timeout on what comes with a period of `[timing]`; "" if nothing."""
    period_s = getattr(timing, period_field)
    least_s = PERIODS_TO_MISS * period_s
    if timeout_s >= least_s - 1e-9:
        return ""
    return (f"would raise false alarms; at least {least_s:.3f} s, {PERIODS_TO_MISS} periods of "
            f"{period_field} = {period_s:.3f} s, is right")
