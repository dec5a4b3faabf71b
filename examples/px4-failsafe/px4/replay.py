"""Replays the steps of `events.toml` as flags of a vehicle, and judges each decision.

Actions and what PX4 decides are those of its own tests, in
`src/modules/commander/failsafe/failsafe_test.cpp` of PX4-Autopilot (2026).
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from rampart import Actor, Context, Header, Judge, Message, Qos, Topic, Verdict, every, on
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import ManagerStatus, Reset

EVENTS = Path(__file__).parent.parent / "events.toml"
ACTIONS = {"R_WARN": "Warn", "R_HOLD": "Hold", "R_RETURN": "RTL", "R_RETURN_KEPT": "RTL",
           "R_LAND": "Land", "R_DESCEND": "Descend", "R_TERMINATE": "Terminate"}
"""PX4's name of each recovery, the mildest first."""


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What happens to the vehicle, and what is decided for `lasts_s` simulated seconds.

    Attributes:
        what: The event, for people.
        flags: Flags of PX4 that are set; all others are clear.
        mode: Flight mode that the user wants.
        px4: Action that PX4's test expects.
        rampart: Action that this specification leads to, if it is another one.
        why: Reason for the difference.
    """

    what: str
    px4: str
    flags: tuple[str, ...] = ()
    mode: str = "POSCTL"
    lasts_s: float = 1.0
    rampart: str = ""
    why: str = ""

    @property
    def expected(self) -> str:
        """The action that has to be in force at the end of the step."""
        return self.rampart or self.px4


STEPS = msgspec.convert(tomllib.loads(EVENTS.read_text(encoding="utf-8"))["step"],
                        tuple[Step, ...])
FLAGS_OF_PX4 = {
    "manual_control_signal_lost": "manual", "gcs_connection_lost": "gcs",
    "mission_failure": "mission", "battery_low_remaining_time": "battery",
    "offboard_control_signal_lost": "offboard", "wind_limit_exceeded": "wind",
    "navigator_failure": "navigator", "fd_motor_failure": "motor",
    "fd_critical_failure": "critical", "global_position_invalid": "position"}
"""PX4's name of a flag → the field of `Flags`."""

DELAYED = ("manual", "gcs", "mission", "battery", "offboard")
"""Flags whose action waits in Hold, for the time of PX4's COM_FAIL_ACT_T."""


class Flags(Message, frozen=True):
    """Flags of the vehicle, 0 or 1; see PX4's `failsafe_flags`."""

    manual: int = 0
    gcs: int = 0
    mission: int = 0
    battery: int = 0
    offboard: int = 0
    wind: int = 0
    navigator: int = 0
    motor: int = 0
    critical: int = 0
    position: int = 0
    delayed: int = 0
    termination: int = 0


class Position(Message, frozen=True):
    """The step that the replay is in, from 0, and how long it lasts yet, s."""

    step: int
    left_s: float


FLAGS = Topic("px4/flags", Flags, Qos.SENSOR, 20, "", "Flags of the vehicle.")
POSITION = Topic("px4/position", Position, Qos.STATE, 20, "", "Where the replay is.")


class Vehicle(Actor):
    """Plays the steps one after the other."""

    outputs = (FLAGS, POSITION, topics.RESET)
    node_kind = "world"

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._mode = STEPS[0].mode

    @every(0.05)
    def play(self) -> None:
        """Publish the flags of now; a change of the mode resets the return that is kept."""
        now_s, begun_s = self.clock.now(), 0.0
        for number, step in enumerate(STEPS):
            if now_s < begun_s + step.lasts_s or number == len(STEPS) - 1:
                break
            begun_s += step.lasts_s
        if step.mode != self._mode:
            self._mode = step.mode
            self.publish(topics.RESET, Reset("R_RETURN_KEPT", "mode_change"))
        flags = {FLAGS_OF_PX4[flag] for flag in step.flags}
        if step.mode != "AUTO_MISSION":
            flags.discard("mission")
        self.publish(FLAGS, Flags(
            **dict.fromkeys(flags, 1), delayed=len(flags & set(DELAYED)),
            termination=int(step.mode == "TERMINATION")))
        self.publish(POSITION, Position(number, begun_s + step.lasts_s - now_s))


class Decisions(Judge):
    """Success: each step ends with the expected action. Safe: with none milder than that."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._action = "None"
        self._found: dict[int, str] = {}
        self._done = False

    @on(topics.MANAGER_STATUS)
    def status(self, message: ManagerStatus, _header: Header) -> None:
        """Note the most severe action in force."""
        in_force = [action for name, action in ACTIONS.items() if name in message.activated]
        self._action = in_force[-1] if in_force else "None"

    @on(POSITION)
    def position(self, message: Position, _header: Header) -> None:
        """Note the action; the last one of each step counts."""
        if message.left_s > 0:
            self._found[message.step] = self._action
        else:
            self._done = True

    def over(self, _now_s: float) -> str | None:
        """Return that all steps are done."""
        return "all steps are done" if self._done else None

    def verdict(self) -> Verdict:
        """Compare what was decided with what has to be."""
        severity = ["None", *dict.fromkeys(ACTIONS.values())].index
        pairs = [(step, self._found.get(number, "None")) for number, step in enumerate(STEPS)]
        wrong = [f"{step.what}: {found}, expected {step.expected}"
                 for step, found in pairs if found != step.expected]
        safe = all(severity(found) >= severity(step.expected) for step, found in pairs)
        return Verdict(success=self._done and not wrong, reasons=tuple(wrong),
                       safe=safe if self._done else None)
