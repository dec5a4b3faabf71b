"""`Progress`: a task takes a wrong step, or one too long or too short (logical supervision)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import msgspec

from rampart.actors.detection.finding import Finding
from rampart.actors.detection.module import DetectionModule
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import FieldName, OptionalFieldName, Suspects
from rampart.manager.spec.tables import Positive

ROUNDING_S = 1e-9


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A step of a task.

    Attributes:
        at: Value of the field during this step.
        within_s: Longest time that it takes, simulated seconds.
        to: Values of the steps that may follow. By default the next one in the list, and the first
            after the last.
        at_least_s: Shortest time until the next step.
    """

    at: str | bool | float
    within_s: float = math.inf
    to: tuple[str | bool | float, ...] | None = None
    at_least_s: float = 0.0


class ProgressMonitor(Finding):
    """Active from a step that is not allowed to follow, or takes too long, until the next step.

    Args:
        what: Name of the field, for the reason.
        steps: All steps.
        busy_at_most_s: How much longer a step may take that reports to be busy.
        known_after_s: When to report idle without any input; -inf for at once.
        each: Whether every message is a step, a check point that the task has passed. Otherwise
            the same value again is the same step.
    """

    def __init__(self, what: str, steps: Sequence[Step], busy_at_most_s: float,
                 known_after_s: float = -math.inf, *, each: bool = False) -> None:
        super().__init__(known_after_s)
        self._what = what
        self._each = each
        self._steps = {step.at: step for step in steps}
        self._next = {step.at: (steps[(i + 1) % len(steps)].at,) if step.to is None else step.to
                      for i, step in enumerate(steps)}
        self._busy_at_most_s = busy_at_most_s
        self._at: Any = None
        self._since_s = math.inf
        self._busy_until_s = -math.inf
        self._has_missed = False
        self.accused: tuple[str, ...] = ()

    @property
    def due_s(self) -> float:
        """When the step has taken too long, or the wait for a first input ends."""
        return min(math.inf if self.active else self._late_s, super().due_s)

    @property
    def _late_s(self) -> float:
        step = self._steps.get(self._at)
        if step is None or step.within_s == math.inf:
            return math.inf
        late_s = self._since_s + step.within_s
        return max(late_s, min(self._busy_until_s, late_s + self._busy_at_most_s))

    def heard(self, at: Any, now_s: float) -> None:
        """Note the present step."""
        self.known = True
        before = None if self._has_missed else self._at
        self._has_missed = False
        if at == self._at and not self._each:
            self.expire(now_s)
            return
        lasted_s, self._at, self._since_s = now_s - self._since_s, at, now_s
        if at not in self._steps:
            self._accuse(f"{self._what} is {at!r}, not one of its steps")
        elif before in self._steps and at not in self._next[before]:
            expected = " or ".join(map(repr, self._next[before])) or "nothing"
            self._accuse(f"{self._what} is {at!r} after {before!r}, expected {expected}")
        elif before in self._steps and lasted_s < self._steps[before].at_least_s - ROUNDING_S:
            self._accuse(f"{self._what} is {at!r} {lasted_s:.3g} s after {before!r}, expected at "
                         f"least {self._steps[before].at_least_s:g} s")
        else:
            self.clear()

    def missed(self) -> None:
        """Note that steps may have been missed."""
        self._has_missed = True

    def busy(self, until_s: float) -> None:
        """Note until when the step is busy; a time that is not finite counts as never."""
        self._busy_until_s = until_s if math.isfinite(until_s) else -math.inf

    def expire(self, now_s: float) -> None:
        """Conclude from the time without an event."""
        super().expire(now_s)
        if not self.active and now_s >= self._late_s:
            self._accuse(f"{self._what} is {self._at!r} for more than "
                         f"{self._late_s - self._since_s:g} s")

    def _accuse(self, reason: str) -> None:
        self.reason, self.nodes = reason, self.accused


class Progress(DetectionModule):
    """Active while a task is at a step that may not follow, or has been at one for too long."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """A task and its steps.

        Attributes:
            value: the present step, as "topic:field".
            steps: all steps: `at` with `within_s`, `at_least_s` and `to`, see `Step`.
            each: whether every message is a step, a check point that the task has passed.
            busy_until: until when it is busy, in simulated seconds, as "topic:field"; "" if the
                task does not report that.
            busy_at_most_s: by how much that may exceed `within_s`, s.
            suspects: nodes to be respawned while it is active; none by default.
        """

        value: FieldName
        steps: Annotated[tuple[Step, ...], msgspec.Meta(min_length=2)]
        busy_until: OptionalFieldName = ""
        busy_at_most_s: Positive = 60.0
        each: bool = False
        suspects: Suspects = ()

        def __post_init__(self) -> None:
            """Refuse steps that contradict each other, or lead to an unknown one."""
            known = [step.at for step in self.steps]
            for step in self.steps:
                if known.count(step.at) > 1:
                    raise ValueError(f"steps: {step.at!r} is listed twice")
                if not step.within_s > 0:
                    raise ValueError(f"steps: within_s of {step.at!r} must be above 0")
                if not 0 <= step.at_least_s <= step.within_s:
                    raise ValueError(f"steps: at_least_s of {step.at!r} must be from 0 to within_s")
                for at in step.to or ():
                    if at not in known:
                        raise ValueError(f"steps: {step.at!r} leads to {at!r}, which is not a step")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        chosen = self.parameters
        self.monitor = self.judged_by(ProgressMonitor(
            chosen.value, chosen.steps, chosen.busy_at_most_s, self.known_after_s(1.0),
            each=chosen.each))
        self._incarnation_heard = 0
        if chosen.busy_until:
            self.hear_field(chosen.busy_until, self.busy)
        self.hear_field(chosen.value, self.heard)

    def missed(self) -> None:
        """Accept any next step."""
        self.monitor.missed()

    def heard(self, value: Any, header: Header) -> None:
        """Note the present step."""
        self.note_absence()
        if header.incarnation != self._incarnation_heard:  # a new process may begin at any step
            self._incarnation_heard = header.incarnation
            self.monitor.missed()
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.monitor.heard(value, self.clock.now())
        self.follow()

    def busy(self, until_s: Any, _header: Header) -> None:
        """Note until when the task is busy."""
        self.monitor.busy(until_s)
        self.follow()
