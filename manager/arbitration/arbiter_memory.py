"""What of the arbiter's state must survive the FTM Manager's death, and how it is taken up again.

Little: an arbiter that starts learns from the modules what is detected and what is in force, adopts
it, and releases nothing before it has heard them all. Four things only the arbiter knows:

* *Latches.* Whether an operator has reset an emergency stop is the arbiter's knowledge. If it dies
  together with a recovery module that cannot find out from the world what it has done (RM1 can, by
  the brakes), no process is left that knows, and the plant would go on.
* *That one of these does not latch*, because what it is for is explained for a while.
* *How much a detection module has flapped*, by which its all-clear is believed sooner or later.
* *The number of the last decision*, so that none is given twice.

A wrong memory can only stop the robot: it can latch, and release nothing whose
cause is still there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec
from msgspec.structs import replace

from rampart.manager.arbitration.arbiter import LARGEST_NUMBER, Arbiter
from rampart.manager.arbitration.arbiter_state import LONG_AGO_S, Command, RecoveryTrack, State
from rampart.manager.arbitration.detection_track import DetectionTrack


class Latch(msgspec.Struct, frozen=True):
    """A recovery that stays until it is reset: what it was told last, and for which detections.

    A safer one may have taken its place for a while. `latched_s` is since when it stays; a latch of
    unknown age is excused by nothing. Not `latched` is one in force that would be latched, but for
    what explains its cause.
    """

    command: Command
    cause: tuple[tuple[str, int], ...]
    latched_s: float = LONG_AGO_S
    latched: bool = True


class Memory(msgspec.Struct, frozen=True):
    """What the arbiter must not forget.

    Attributes:
        number: of the last decision.
        latches: the latched recoveries, and those that what explains their causes excuses.
        buckets: of detection modules that have flapped: name, content, and when that was true;
            see `rampart.manager.arbitration.detection_track`.
    """

    number: int
    latches: tuple[Latch, ...] = ()
    buckets: tuple[tuple[str, float, float], ...] = ()


def remember(state: State, arbiter: Arbiter) -> Memory:
    """Return what of a state must not be forgotten."""
    contracts = arbiter.mechanisms.contracts
    latches = (Latch(t.command, tuple(sorted(t.cause)), t.latched_s, t.latched)
               for t in state.recoveries
               if t.latched or (t.wanted and contracts[t.name].excused_by))
    buckets = ((t.name, t.bucket_s, t.bucket_at_s) for t in state.detections if t.bucket_s > 0)
    return Memory(state.number, tuple(latches), tuple(buckets))


def recall(arbiter: Arbiter, memory: Memory, now: float, number: int) -> State:
    """Return the state in which an arbiter starts that has a memory.

    Args:
        arbiter: the rules; modules that it does not know are left out.
        memory: of the arbiter before.
        now: time, seconds.
        number: decisions are numbered from here on, or from the memory's number if that is higher.
    """
    state = arbiter.initial(now, max(number, memory.number))
    detections = {t.name: t for t in state.detections}
    kept = [replace(detections[name], bucket_s=bucket_s, bucket_at_s=min(at_s, now))
            for name, bucket_s, at_s in memory.buckets if name in detections]
    return _with_tracks(state, kept, [
        RecoveryTrack(latch.command, ordered_s=now, cause=frozenset(latch.cause),
                      adopted=not latch.latched, latched=latch.latched,
                      latched_s=min(latch.latched_s, now)) for latch in memory.latches])


def take_over(arbiter: Arbiter, state: State, now: float) -> State:
    """Return the state of another arbiter, one of the same system before a change, as this one's.

    What is known of modules that there still are is kept; new ones are waited for.
    """
    fresh = _with_tracks(
        arbiter.initial(now, state.number), state.detections, state.recoveries)
    return replace(fresh, started_s=state.started_s, oriented=state.oriented)


def _with_tracks(state: State, detections: Iterable[DetectionTrack],
                 recoveries: Iterable[RecoveryTrack]) -> State:
    """Return a state with other tracks for those of its modules that these are of."""
    known = {track.name: track for track in detections}
    commanded = {track.name: track for track in recoveries}
    return replace(
        state, detections=tuple(known.get(t.name, t) for t in state.detections),
        recoveries=tuple(commanded.get(t.name, t) for t in state.recoveries))


def objection(memory: Memory) -> str:
    """Say why a memory makes no sense; "" if it does."""
    if not 0 <= memory.number <= LARGEST_NUMBER:
        return f"decision number {memory.number}"
    for name, bucket_s, at_s in memory.buckets:
        if not (math.isfinite(bucket_s) and math.isfinite(at_s) and bucket_s >= 0):
            return f"bucket of {name} holds {bucket_s} s"
    return ""
