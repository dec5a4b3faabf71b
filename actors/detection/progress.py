"""`Progress`: a task goes through its steps in order, and in time (logical supervision)."""

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


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A step of a task.

    Attributes:
        at: value of the field while the task is at this step.
        within_s: longest time that it takes, simulated seconds.
        to: values of the steps that may follow; if left out the next in the list, and after the
            last one the first.
    """

    at: str | bool | float
    within_s: float = math.inf
    to: tuple[str | bool | float, ...] | None = None


class ProgressMonitor(Finding):
    """Active from a step that is not one of those that follow, or takes too long, until the next.

    Args:
        what: is followed, for the reason.
        steps: all there are.
        busy_at_most_s: how much longer a step may take that reports to be busy.
        known_after_s: when idle may be claimed without anything heard; -inf for at once.
    """

    def __init__(self, what: str, steps: Sequence[Step], busy_at_most_s: float,
                 known_after_s: float = -math.inf) -> None:
        super().__init__(known_after_s)
        self._what = what
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
        """Take note of where the task is."""
        self.known = True
        before = None if self._has_missed else self._at
        self._has_missed = False
        if at == self._at:
            self.expire(now_s)
            return
        self._at, self._since_s = at, now_s
        if at not in self._steps:
            self._accuse(f"{self._what} is {at!r}, which is no step")
        elif before in self._steps and at not in self._next[before]:
            right = " or ".join(map(repr, self._next[before])) or "nothing"
            self._accuse(f"{self._what} is {at!r} after {before!r}; right is {right}")
        else:
            self.clear()

    def missed(self) -> None:
        """Take note that the task may have gone on by several steps unheard."""
        self._has_missed = True

    def busy(self, until_s: float) -> None:
        """Take note that the step is busy until then; a time that is not finite counts as never."""
        self._busy_until_s = until_s if math.isfinite(until_s) else -math.inf

    def expire(self, now_s: float) -> None:
        """Conclude from the time that has passed."""
        super().expire(now_s)
        if not self.active and now_s >= self._late_s:
            self._accuse(f"{self._what} is {self._at!r} for more than "
                         f"{self._late_s - self._since_s:g} s")

    def _accuse(self, reason: str) -> None:
        self.reason, self.nodes = reason, self.accused


class Progress(DetectionModule):
    """Active while a task takes a step that is not next, or stays at one for too long."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Which task, and its steps.

        Attributes:
            value: the step at which it is, as "topic:field".
            steps: all there are: `at` with `within_s` and `to`, see `Step`.
            busy_until: until when it is busy and must not be hurried, in simulated seconds, as
                "topic:field"; "" if it does not report that.
            busy_at_most_s: by how much that may exceed `within_s`, s.
            suspects: names of nodes to be respawned when it is active; none by default.
        """

        value: FieldName
        steps: Annotated[tuple[Step, ...], msgspec.Meta(min_length=2)]
        busy_until: OptionalFieldName = ""
        busy_at_most_s: Positive = 60.0
        suspects: Suspects = ()

        def __post_init__(self) -> None:
            """Refuse steps that contradict each other, or lead nowhere."""
            known = [step.at for step in self.steps]
            for step in self.steps:
                if known.count(step.at) > 1:
                    raise ValueError(f"steps: {step.at!r} stands twice")
                if not step.within_s > 0:
                    raise ValueError(f"steps: within_s of {step.at!r} must be above 0")
                for at in step.to or ():
                    if at not in known:
                        raise ValueError(f"steps: {step.at!r} leads to {at!r}, which is not a step")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        said = self.parameters
        self.monitor = self.judged_by(ProgressMonitor(
            said.value, said.steps, said.busy_at_most_s, self.known_after_s(1.0)))
        if said.busy_until:
            self.hear_field(said.busy_until, self.busy)
        self.hear_field(said.value, self.heard)

    def missed(self) -> None:
        """Take the next step that is heard for right, whichever it is."""
        self.monitor.missed()

    def heard(self, value: Any, header: Header) -> None:
        """Take note of where the task is."""
        self.note_absence()
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.monitor.heard(value, self.clock.now())
        self.follow()

    def busy(self, until_s: Any, _header: Header) -> None:
        """Take note of until when it is busy."""
        self.monitor.busy(until_s)
        self.follow()
