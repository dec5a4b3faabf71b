"""The part of the arbiter's state that survives the FTM Manager's death.

An arbiter that starts learns from the modules what is detected and in force, and adopts it. Four
facts are known only to the arbiter:

* *Latches* of recoveries, and mechanisms that outlast their errors. If the manager dies together
  with a recovery module that cannot read its state from the world, as RM1 can from the brakes, no
  other process knows that the robot must stay stopped.
* *That a recovery does not latch*, because its cause is explained for a while.
* *How much a detection module has flapped*, which delays the release of its mechanisms.
* *The number of the last decision*, so that no number is used twice.

A wrong memory can only stop the robot. It may latch, but releases nothing whose cause persists.
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
    """A recovery that stays until it is reset: its last command, its causes, and since when.

    Nothing excuses a latch of unknown age. `latched` is false for a recovery in force that does not
    latch because its cause is explained.
    """

    command: Command
    cause: tuple[tuple[str, int], ...]
    latched_s: float = LONG_AGO_S
    latched: bool = True


class Memory(msgspec.Struct, frozen=True):
    """The number of the last decision, and what else the arbiter must not forget.

    Attributes:
        latches: Latched recoveries, and recoveries in force that are excused from latching.
        buckets: Name, content in s and time in s of the bucket of each module that has flapped;
            see `rampart.manager.arbitration.detection_track`.
        held: Name, time of activation and time of the last detection, in s, of each mechanism that
            outlasts its error.
    """

    number: int
    latches: tuple[Latch, ...] = ()
    buckets: tuple[tuple[str, float, float], ...] = ()
    held: tuple[tuple[str, float, float], ...] = ()


def remember(state: State, arbiter: Arbiter) -> Memory:
    """Return the memory of a state."""
    contracts = arbiter.mechanisms.contracts
    latches = (Latch(t.command, tuple(sorted(t.cause)), t.latched_s, t.latched)
               for t in state.recoveries
               if t.latched or (t.wanted and contracts[t.name].excused_by))
    buckets = ((t.name, t.bucket_s, t.bucket_at_s) for t in state.detections if t.bucket_s > 0)
    held = tuple((h.mechanism, h.since_s, h.seen_s) for h in state.held)
    return Memory(state.number, tuple(latches), tuple(buckets), held)


def recall(arbiter: Arbiter, memory: Memory, now: float, number: int) -> State:
    """Return the state in which an arbiter with a memory starts at time `now`, seconds.

    Modules that the arbiter does not know are left out. `number` is the number before that of the
    first decision, unless the memory's is higher.
    """
    state = arbiter.initial(now, max(number, memory.number))
    detections = {t.name: t for t in state.detections}
    kept = [replace(detections[name], bucket_s=bucket_s, bucket_at_s=min(at_s, now))
            for name, bucket_s, at_s in memory.buckets if name in detections]
    state = replace(state, held=tuple(
        arbiter.hold(name, min(since_s, now), min(seen_s, now))
        for name, since_s, seen_s in memory.held if name in arbiter.mechanisms.outlasting))
    return _with_tracks(state, kept, [
        RecoveryTrack(latch.command, ordered_s=now, cause=frozenset(latch.cause),
                      adopted=not latch.latched, latched=latch.latched,
                      latched_s=min(latch.latched_s, now)) for latch in memory.latches])


def take_over(arbiter: Arbiter, state: State, now: float) -> State:
    """Return the state of the arbiter before an adaptation as a state of this one.

    Tracks of modules that stay are kept; new modules are awaited.
    """
    fresh = _with_tracks(
        arbiter.initial(now, state.number), state.detections, state.recoveries)
    return replace(fresh, started_s=state.started_s, oriented=state.oriented)


def _with_tracks(state: State, detections: Iterable[DetectionTrack],
                 recoveries: Iterable[RecoveryTrack]) -> State:
    """Return a state in which these tracks replace those of the same modules."""
    detected = {track.name: track for track in detections}
    commanded = {track.name: track for track in recoveries}
    return replace(
        state, detections=tuple(detected.get(t.name, t) for t in state.detections),
        recoveries=tuple(commanded.get(t.name, t) for t in state.recoveries))


def objection(memory: Memory) -> str:
    """Return what is implausible in a memory, or ""."""
    if not 0 <= memory.number <= LARGEST_NUMBER:
        return f"decision number {memory.number}"
    for name, bucket_s, at_s in memory.buckets:
        if not (math.isfinite(bucket_s) and math.isfinite(at_s) and bucket_s >= 0):
            return f"bucket of {name} holds {bucket_s} s"
    for name, since_s, seen_s in memory.held:
        if not (math.isfinite(since_s) and math.isfinite(seen_s)):
            return f"{name} is held since {since_s} s, seen at {seen_s} s"
    return ""
