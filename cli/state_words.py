"""States of the run in one line each, as `rampart status` and `rampart top` tell them. Pure."""

from __future__ import annotations

from rampart.actors.ftm import messages as fm
from rampart.actors.osmosis import messages as m

SILENT = "silent"
"""What there is to say of whoever was not heard."""


def mission_in_words(status: m.MissionStatus | None) -> str:
    """Return how far the mission is."""
    if status is None:
        return SILENT
    if not status.goals:
        return status.phase.value
    steps = len(status.goals)
    text = (f"{status.name} {status.phase.value}, step {min(status.step + 1, steps)} of {steps}, "
            f"{len(status.lights)} lights measured")
    return f"{text}: {status.reason}" if status.reason else text


def pilot_in_words(status: m.PilotStatus | None) -> str:
    """Return whose commands the Safety Pilot passes, and whether it holds the robot."""
    if status is None:
        return SILENT
    text = f"{status.mode.value}, {'STOPPED' if status.stopped else 'driving'}"
    return f"{text}: {status.reason}" if status.reason else text


def manager_in_words(status: fm.ManagerStatus | None) -> str:
    """Return what the FTM Manager sees and does."""
    if status is None:
        return SILENT
    parts = [f"{status.strategy}, decision {status.decision}"]
    parts += [f"{word} {', '.join(names)}" for word, names in (
        ("ACTIVE", status.active), ("recovery", status.activated),
        ("latched", status.latched), ("silent", status.silent)) if names]
    if len(parts) == 1:
        parts.append("nothing active")
    return "; ".join(parts)
