"""Every ordered pair of mechanisms: what runs while both are active, and what stays afterwards.

The arbiter's own code decides. Every module obeys at once, and no hold delays a release.
"""

from __future__ import annotations

from itertools import combinations, permutations

import msgspec
from msgspec.structs import replace

from rampart.manager.arbitration.arbiter import Arbiter, build_arbiter
from rampart.manager.arbitration.arbiter_state import Command, Input, RecoveryHeard, State, Tick
from rampart.manager.arbitration.detection_track import DetectionHeard
from rampart.manager.model.mechanisms import RecoveryPhase
from rampart.manager.spec.schema import SystemSpec

_LATER_S = 0.01


class Pair(msgspec.Struct, frozen=True):
    """Two mechanisms, of which `first` became active before `second`.

    Attributes:
        both: The recoveries in force while both are active.
        first_clears: Those in force when only the error of the first one is gone.
        second_clears: Those in force when only the error of the second one is gone.
        both_clear: Those in force when both errors are gone: they are latched, or a mechanism has
            not cleared.
    """

    first: str
    second: str
    both: tuple[str, ...]
    first_clears: tuple[str, ...]
    second_clears: tuple[str, ...]
    both_clear: tuple[str, ...]


def pairs(spec: SystemSpec) -> tuple[Pair, ...]:
    """Return all ordered pairs of a system's mechanisms, in the declared sequence."""
    model = _Model(spec)
    return tuple(model.pair(first, second)
                 for first, second in permutations(model.mechanisms.names, 2))


def causes_of(spec: SystemSpec, mechanism: str) -> tuple[str, ...]:
    """Return the fewest detection modules that make a mechanism active, of these the first."""
    mechanisms = spec.build_mechanisms()
    modules = mechanisms.detect[mechanism]
    return next(chosen for count in range(1, len(modules) + 1)
                for chosen in combinations(modules, count)
                if mechanism in mechanisms.detected_by(chosen))


class _Model:
    """The arbiter of a system with modules that obey at once."""

    def __init__(self, spec: SystemSpec) -> None:
        timing = replace(spec.timing, release_hold_s=0.0, release_hold_max_s=0.0)
        self.arbiter: Arbiter = build_arbiter(replace(spec, timing=timing))
        self.mechanisms = self.arbiter.mechanisms
        self._causes = {name: set(causes_of(spec, name)) for name in self.mechanisms.names}
        state = self.arbiter.initial(0.0)
        for name in self.mechanisms.detections:
            state = self._feed(state, DetectionHeard(name, False), 0.0)
        for name in self.mechanisms.recoveries:
            state = self._feed(state, RecoveryHeard(name, False, RecoveryPhase.IDLE, 0), 0.0)
        self._idle = state

    def pair(self, first: str, second: str) -> Pair:
        """Make the first mechanism active, then the second, then clear each."""
        one, other = self._causes[first], self._causes[second]
        begun = self._with(self._idle, set(), one, 1)
        both = self._with(begun, one, one | other, 2)
        without_first = self._with(both, one | other, other, 3)
        without_second = self._with(both, one | other, one, 3)
        return Pair(first, second, _in_force(both), _in_force(without_first),
                    _in_force(without_second),
                    _in_force(self._with(without_first, other, set(), 4)))

    def _with(self, state: State, before: set[str], after: set[str], step: int) -> State:
        """Return the state after detection modules have become active or idle."""
        now_s = step * _LATER_S
        for name in self.mechanisms.detections:
            if (name in before) != (name in after):
                state = self._feed(
                    state, DetectionHeard(name, name in after, since_s=now_s), now_s)
        return self._feed(state, Tick(), now_s)

    def _feed(self, state: State, event: Input, now_s: float) -> State:
        """Return the state after an input, and after the reports of all modules that obey it."""
        waiting = [event]
        while waiting:
            state, outputs = self.arbiter.step(state, waiting.pop(0), now_s)
            waiting += [self._obey(o) for o in outputs if isinstance(o, Command)]
        return state

    def _obey(self, command: Command) -> RecoveryHeard:
        repairs = self.mechanisms.contracts[command.recovery].kind.repairs
        phase = (RecoveryPhase.IDLE if not command.activate
                 else RecoveryPhase.DONE if repairs else RecoveryPhase.DEGRADED)
        return RecoveryHeard(command.recovery, command.activate, phase, command.decision)


def _in_force(state: State) -> tuple[str, ...]:
    return tuple(track.name for track in state.recoveries if track.wanted)
