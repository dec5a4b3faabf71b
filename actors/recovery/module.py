"""Base of recovery modules: states, commands, reports.

A recovery module obeys the last command of the FTM Manager, and publishes its phase on
`recovery/NAME/state`: each change at once, and the present phase five times a second.

* *A repeated command is one command.* The manager repeats its commands. Only a new decision number
  is a new order, given because the cause has come back.
* *An action is never cut off.* A release that arrives meanwhile is obeyed when the action is done,
  has reached its degraded mode, or has failed.
* *A respawned module starts idle.* The manager sees that, and commands it again.

The handler of a command acts first, and then reports: no effect of a decision waits for a timer.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import RecoveryCommand, RecoveryReport, RecoveryState
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.timer import Timer
from rampart.manager.model.mechanisms import RecoveryPhase

_P = RecoveryPhase
_ENDS = frozenset({_P.DONE, _P.DEGRADED, _P.FAILED})

TRANSITIONS = {
    _P.IDLE: frozenset({_P.ACTING}),
    _P.ACTING: _ENDS,
    _P.DONE: frozenset({_P.ACTING, _P.FAILED, _P.IDLE}),
    _P.DEGRADED: frozenset({_P.ACTING, _P.FAILED, _P.IDLE}),
    _P.FAILED: frozenset({_P.ACTING, _P.DONE, _P.DEGRADED, _P.IDLE}),
}
"""State machine of recovery modules: idle, or activated (paper, figure 4) in one of four phases.
No step leads from acting to idle, since an action is never cut off. A late success may follow a
failure."""

DEFAULT_DEADLINE_S = 2.0
"""Deadline from command to done of a module without a contract."""

LATE_S = 0.1
"""A deadline noticed this late shows that the module itself did not run."""

_EPSILON_S = 1e-6

_REPEATS_PER_S = 5


class IllegalTransitionError(RuntimeError):
    """A state machine was asked for a step that is not in its table."""


class RecoveryModule(Actor):
    """Base of every recovery module.

    A subclass defines `act` for orders and `let_go` for releases. It calls `succeed`, `degrade` or
    `fail` with the result of the action. The deadline comes from the module's contract in the
    system spec.
    """

    outputs: ClassVar[tuple[Topic[Any], ...]] = (topics.RECOVERY,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.phase = RecoveryPhase.IDLE
        self.decision = 0
        self.ordered_s = -math.inf
        contracts = context.run.system.recoveries
        self.deadline_s = next(
            (c.deadline_s for c in contracts if c.name == self.name), DEFAULT_DEADLINE_S)
        self._reason = ""
        self._due_s = math.inf
        self._deadline: Timer | None = None
        self._excused = False
        self._release: RecoveryCommand | None = None
        self._reported: RecoveryReport | None = None

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Any) -> Members:  # noqa: ARG003
        """Subscribe to its own commands."""
        return (name,) if topic is topics.RECOVERY_COMMAND else None

    @property
    def activated(self) -> bool:
        """Whether it is not idle."""
        return self.phase is not RecoveryPhase.IDLE

    def on_start(self) -> None:
        """Report at once."""
        self._tell()

    # -- defined by a subclass ------------------------------------------------------------------

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Take the action.

        Called in phase acting for a first order. Called again, in any phase, for each repetition,
        which may name further nodes, and for a new order (`renewed`).
        """
        raise NotImplementedError

    def let_go(self) -> None:
        """Hand control back."""
        raise NotImplementedError

    def stay_idle(self) -> None:
        """React to a release while idle."""

    def unfinished(self) -> str:
        """Return what is still to do, for the report of a missed deadline."""
        return ""

    def repeat(self) -> None:
        """Act five times a second."""

    # -- result of the action -------------------------------------------------------------------

    def succeed(self, reason: str = "") -> None:
        """Report the action done."""
        self._end(RecoveryPhase.DONE, reason)

    def degrade(self, reason: str = "") -> None:
        """Report that the degraded mode is reached."""
        self._end(RecoveryPhase.DEGRADED, reason)

    def fail(self, reason: str) -> None:
        """Report failure."""
        self._end(RecoveryPhase.FAILED, reason)

    def resume(self, reason: str = "") -> None:
        """Act again, with the whole deadline."""
        self._begin(reason)
        self._tell_change()

    def _begin(self, reason: str) -> None:
        self._excused = False
        self._due_s = self.clock.now() + self.deadline_s
        self._look_at(self.deadline_s)
        if self.phase is not RecoveryPhase.ACTING:
            self._enter(RecoveryPhase.ACTING, reason)

    def _end(self, phase: RecoveryPhase, reason: str) -> None:
        if self.phase is phase:
            return
        self._enter(phase, reason)
        self._tell_change()
        release, self._release = self._release, None
        if release is not None:
            self._obey_release(release)

    # -- commands -------------------------------------------------------------------------------

    @on(topics.RECOVERY_COMMAND)
    def command(self, message: RecoveryCommand, _header: Header) -> None:
        """Obey the manager."""
        if message.activate:
            self._release = None
            self._obey_order(message)
        elif not self.activated:
            self.decision = message.decision  # confirms that nothing is in force
            self.stay_idle()
            self._tell_change()
        elif self.phase is RecoveryPhase.ACTING:
            self._release = message
        else:
            self._obey_release(message)

    def _obey_order(self, message: RecoveryCommand) -> None:
        self.read_postings()
        renewed = self.activated and message.decision != self.decision
        self.decision = message.decision
        if not self.activated:
            self.ordered_s = self.clock.now()
            self._begin(message.reason)
        self.act(message, renewed=renewed)
        self._tell_change()

    def _obey_release(self, message: RecoveryCommand) -> None:
        self.decision = message.decision
        self._enter(RecoveryPhase.IDLE, message.reason)
        self._due_s = math.inf
        self.let_go()
        self._tell_change()

    def _check_deadline(self) -> None:
        late_s = self.clock.now() - self._due_s
        if self.phase is not RecoveryPhase.ACTING:
            return
        if late_s < -_EPSILON_S:  # this host's clock was corrected meanwhile
            self._look_at(-late_s)
            return
        if late_s > LATE_S and not self._excused:  # it was stopped: read the mail first
            self._excused = True
            self._look_at(LATE_S)
        else:
            rest = self.unfinished()
            self.fail(f"not done within {self.deadline_s:g} s{f': {rest}' if rest else ''}")

    def _look_at(self, in_s: float) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = self.call_later(in_s, self._check_deadline)

    def _enter(self, phase: RecoveryPhase, reason: str) -> None:
        if phase not in TRANSITIONS[self.phase]:
            raise IllegalTransitionError(
                f"{self.name}: no transition from {self.phase} to {phase}")
        self.phase = phase
        self._reason = clip(reason)

    # -- reports --------------------------------------------------------------------------------

    def _tell(self) -> None:
        self._reported = self._report()
        self.publish(topics.RECOVERY, self._reported)

    def _tell_change(self) -> None:
        if self._report() != self._reported:
            self._tell()

    def _report(self) -> RecoveryReport:
        state = RecoveryState.ACTIVATED if self.activated else RecoveryState.IDLE
        return RecoveryReport(state, self.phase, self.decision, self._reason)

    @every(1.0 / _REPEATS_PER_S)
    def _repeat(self) -> None:
        self.repeat()
        self._tell()
