"""`rampart joystick`: drive from the terminal's keyboard."""

from __future__ import annotations

import argparse
import asyncio
import math
import sys
import uuid
from typing import Any

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.detection.finding import Lasting
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import Joystick
from rampart.cli.osmosis.lines import pilot_in_words
from rampart.cli.osmosis.mission_verb import checked_reason
from rampart.cli.output import NoEffectError, UsageError, between, say
from rampart.cli.session import Latest, Session, connect, is_over, pause, stopped_by_signals
from rampart.cli.terminal import END, keys
from rampart.cli.verbs import PORT, add_verb, number, option
from rampart.files.plain_text import printable

_PERIOD_S = 0.05
"""Simulated seconds between two positions; not less than `_SHORTEST_S` real ones."""

_SHORTEST_S = 0.01
_SHOW_EVERY_S = 0.25
_ANSWER_S = 1.0
"""Real seconds within which teleoperation has to obey a held joystick."""

_RELEASES = 3

_GRANT_S = 3.0
"""Simulated seconds for the answer to a request for a way out."""


def add(verbs: Any, _formatter: Any, _common: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "joystick", "drive the robot by hand", joystick, PORT,
             number("--speed", "SHARE", "initial share of full speed, 0.1 to 1 (default: 0.5)",
                    0.5),
             option("--way-out", metavar="REASON",
                    help="drive the robot out of a prohibited area, for this reason"))


async def joystick(options: argparse.Namespace) -> int:
    """Drive by hand until the user or the run ends it.

    Drive the robot with the arrow keys, or with u i o j l m , . as in ROS. Space
    or k releases, + and - change the speed, q or Ctrl-C quits.

    Hold the key to drive. A terminal does not report the release of a key, so the
    robot stops within 0.6 s after the last repetition. If it stops once after the
    first moment, shorten the repeat delay of the keyboard (X11: xset r rate 250).
    The operator's page takes a gamepad.

    The robot obeys one joystick at a time: the first that is held. The others get
    a notice.

    In a prohibited area the emergency stop stays in force. With --way-out the robot
    can be driven out, at 0.2 m/s at most and only in directions that lead out. This
    ends on release, and when the robot is out; `rampart reset RM1` then releases the
    brake. Reason and name are recorded.

    Examples:
      rampart joystick
      rampart joystick --speed 0.2
      rampart joystick --way-out "localization was wrong, the grass is dry"

    exit code: 0 driven, 1 no effect, way out refused, or the robot is not out
    """
    between("--speed", options.speed, 0.1, 1)
    if not sys.stdin.isatty():
        raise UsageError("standard input: expected a terminal to read keys from")
    reason = checked_reason(options.way_out, "--way-out") if options.way_out is not None else ""
    stop = asyncio.Event()
    async with connect(options.port) as session:
        if reason:
            way_out = _WayOut(session, reason, stop)
            await way_out.ask()
        drive = _Drive(session, KeyboardStick(options.speed), stop)
        with stopped_by_signals(stop):
            say("hold a key to drive, q quits")
            try:
                with keys(drive.press):
                    await drive.until_stopped()
            finally:
                await drive.let_go()
                say()
        if drive.ended:
            raise NoEffectError(drive.ended)
        if drive.tried and not drive.answered:
            raise NoEffectError("no effect: teleoperation did not answer")
        if reason:
            way_out.conclude()
    return 0


class _WayOut:
    """The operator's request to drive out of a prohibited area, and its answers."""

    def __init__(self, session: Session, reason: str, stop: asyncio.Event) -> None:
        self._session = session
        self._request = m.WayOutRequest(f"rampart-{uuid.uuid4().hex[:10]}", session.name, reason)
        self._answer: m.WayOutAnswer | None = None
        self._stop = stop
        session.listen(topics.WAY_OUT_ANSWER, self._reply)

    async def ask(self) -> None:
        """Ask for the way out.

        Raises:
            NoEffectError: RM1 refuses it, or does not answer.
        """
        await self._session.command(topics.WAY_OUT, self._request,
                                    lambda: self._answer is not None,
                                    self._session.real_s(_GRANT_S))
        if self._answer is None:
            raise NoEffectError("no effect: the emergency stop did not answer")
        if not self._answer.granted:
            raise NoEffectError(f"way out refused: {self._answer.reason}")
        say(f"way out granted: {self._answer.reason}; a release ends it")

    def conclude(self) -> None:
        """Print how the way out has ended.

        Raises:
            NoEffectError: the robot is not out.
        """
        ended = "" if self._answer is None or self._answer.granted else self._answer.reason
        if self._answer is None or not self._answer.is_out:
            raise NoEffectError(f"the robot is not out: {ended or 'the operator ended it'}")
        say(f"{ended}; rampart reset releases the emergency stop")

    def _reply(self, _key: str, _header: Header, answer: m.WayOutAnswer) -> None:
        if answer.order == self._request.order:
            ended = self._answer is not None and self._answer.granted and not answer.granted
            self._answer = answer
            if ended:
                self._stop.set()


class _Drive:
    """The user's keyboard, and the reaction of the robot.

    Args:
        session: the connection to the run.
        keyboard: turns keys into positions.
        stop: set to end.

    Attributes:
        ended: why the drive ended without the user, or "".
        tried: whether the joystick was held long enough for an answer.
        answered: whether teleoperation ever obeyed or refused it.
    """

    def __init__(self, session: Session, keyboard: KeyboardStick, stop: asyncio.Event) -> None:
        self.ended = ""
        self.answered = False
        self._session = session
        self._keyboard = keyboard
        self._stop = stop
        self._loop = asyncio.get_running_loop()
        self._held = Lasting(_ANSWER_S)
        self._releases = 0
        self.tried = False
        self._pilot = Latest[m.PilotStatus]()
        self._base = Latest[m.BaseStatus]()
        session.listen(topics.BASE_STATUS, self._base.keep)
        session.listen(topics.PILOT_STATUS, self._pilot.keep)
        session.listen(topics.TELEOP_COMMAND, self._command)
        session.listen(bus_topics.DIAGNOSTIC, self._diagnostic)

    def press(self, key: str) -> None:
        """Handle a key."""
        if key in {"q", "Q", END}:
            self._stop.set()
        else:
            self._keyboard.press(key, self._loop.time())
            self._send()

    async def until_stopped(self) -> None:
        """Publish the position while it is held, and show the state of the Safety Pilot."""
        period_s = max(_PERIOD_S / self._session.clock.rate, _SHORTEST_S)
        shown_s = 0.0
        while not self._stop.is_set():
            if is_over(self._session.run):
                self.ended = "the run has ended"
                return
            self._send()
            if self._loop.time() - shown_s >= _SHOW_EVERY_S:
                shown_s = self._loop.time()
                self._show()
            await pause(self._stop, period_s)

    async def let_go(self) -> None:
        """Publish the release."""
        for _ in range(_RELEASES):
            self._session.publish(topics.JOYSTICK, m.Joystick(0.0, 0.0, False))
            await asyncio.sleep(_SHORTEST_S)

    def _send(self) -> None:
        stick = self._keyboard.stick(self._loop.time())
        if stick.dead_man:
            self.tried = self._held.note(True, self._loop.time()) or self.tried
            self._releases = _RELEASES
        else:
            self._held.forget()
            self._releases -= 1
        if self._releases >= 0:
            self._session.publish(topics.JOYSTICK, stick)

    def _show(self) -> None:
        stick, pilot = self._keyboard.stick(self._loop.time()), self._pilot.value
        text = (f"forward {stick.forward:+.0%} left {stick.left:+.0%}" if stick.dead_man
                else "let go")
        text += f"  speed {self._keyboard.speed:.0%}"
        if pilot is not None:
            text += f"  pilot {pilot_in_words(pilot, self._base.value)}"
        sys.stdout.write(f"\r{printable(text)[:78]:<78}")
        sys.stdout.flush()

    def _command(self, _key: str, _header: Header, _twist: m.Twist) -> None:
        self.answered = self.answered or self._held.since_s < math.inf

    def _diagnostic(self, _key: str, _header: Header, report: bm.Diagnostic) -> None:
        if report.offender == self._session.name:
            self.answered = True
            sys.stdout.write("\r")
            say(f"{report.node}: {report.reason.replace(self._session.name, 'you')}")


HOLD_S = 0.5
"""Real seconds for which a key counts. With the period and the way to the base, the robot stands
within 0.6 s."""

STEP = 0.1
_DIRECTIONS: dict[str, tuple[float, float]] = {
    "up": (1, 0), "down": (-1, 0), "left": (0, 1), "right": (0, -1),
    "u": (1, 1), "i": (1, 0), "o": (1, -1), "j": (0, 1), "l": (0, -1),
    "m": (-1, -1), ",": (-1, 0), ".": (-1, 1)}
"""Arrow keys, and the letters of ROS's teleop_twist_keyboard, which can do both at once. With m and
. the robot reverses, and its tail goes to the side of the key."""

_LET_GO = (" ", "k")


class KeyboardStick:
    """Keys in, position of a joystick out. Pure.

    A terminal reports a key when it is pressed and while it is held, but not its release. So the
    dead-man switch is the *repetition*: each key counts for `HOLD_S`, and without the next one the
    joystick is released. Most keyboards wait for 0.25 to 0.5 s before the first repetition. With a
    longer delay the robot stops once.

    Args:
        speed: initial share of full speed, 0.1 to 1.
    """

    def __init__(self, speed: float = 0.5) -> None:
        self.speed = min(max(speed, STEP), 1.0)
        self._direction = (0.0, 0.0)
        self._until_s = 0.0

    def press(self, key: str, now_s: float) -> bool:
        """Handle a key at a real time; return whether it has a meaning."""
        if key in _DIRECTIONS:
            self._direction = _DIRECTIONS[key]
            self._until_s = now_s + HOLD_S
        elif key in _LET_GO:
            self._until_s = now_s
        elif key in {"+", "="}:
            self.speed = min(1.0, round(self.speed + STEP, 1))
        elif key == "-":
            self.speed = max(STEP, round(self.speed - STEP, 1))
        else:
            return False
        return True

    def stick(self, now_s: float) -> Joystick:
        """Return the position at a real time."""
        if not now_s < self._until_s:
            return Joystick(0.0, 0.0, False)
        forward, left = self._direction
        return Joystick(forward * self.speed, left * self.speed, True)
