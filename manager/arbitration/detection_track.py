"""What the arbiter believes about one detection module.

Belief differs from the last report in two ways.

*Silence counts as active.* A dead module cannot report its death, hence one of which there is no
report younger than `silence_timeout_s` is taken for active, whatever the reason: also while it is
being respawned, which takes a fraction of the timeout, and one that crashes again and again is not
excused for good. Age is that of the report, not of its arrival: a repeated old report is silence.

*One that runs and is not heard is replaced* once, well before its silence counts (`overdue`): its
way out may be broken where its heartbeat's is not. Not while others are late as well: then it is
the machine, or who listens, and a module that is killed for being late comes later still.

*Active at once, idle after a while.* A flapping module must not thrash the arbiter: a recovery
started and released with every flap. So it has to stay idle for a hold before it is believed. The
hold is a bucket: every rise pours in `release_hold_s`, and it leaks so slowly that a full one
takes `release_hold_max_s` per portion. Therefore

* flaps closer together than `release_hold_max_s` pour in faster than leaks out; the hold grows
  past the gaps between them, and the flapping is seen as one long activity: no thrashing;
* flaps further apart do not build up, and a release per `release_hold_max_s` is not thrashing;
* the bucket is no larger than `release_hold_max_s`, so that long after the last flap the recovery
  is released for certain: no starvation either.

A single fault finds the bucket empty and is held for `release_hold_s`. With both times 0 there is
no hold: so it is once a repair has been done (see `Arbiter`).
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace


class DetectionHeard(msgspec.Struct, frozen=True, tag=True):
    """Input: a report of a detection module.

    Attributes:
        detection: Its name.
        active: Its state.
        reason: Why.
        nodes: Failed nodes that it names.
        since_s: When it took that state.
        stamp_s: When the report was true; infinite for now.
        incarnation: Its own.
    """

    detection: str
    active: bool
    reason: str = ""
    nodes: tuple[str, ...] = ()
    since_s: float = 0.0
    stamp_s: float = math.inf
    incarnation: int = 0


class DetectionRules(msgspec.Struct, frozen=True):
    """Times by which belief follows reports, all in seconds; see `schema.Timing`."""

    silence_timeout_s: float
    startup_grace_s: float
    release_hold_s: float
    release_hold_max_s: float


class DetectionTrack(msgspec.Struct, frozen=True):
    """Belief about one detection module.

    Attributes:
        name: Of the module.
        heard_s: When its newest report was true, or else when its time to report began to run.
        incarnation: Its own, as last heard; 0 before.
        ever_heard: Whether it was heard at all since the arbiter started.
        reported: What it last said: active or not.
        silent: Not heard for too long.
        active: What the arbiter acts on.
        rises: How often it became active.
        since_s: Since when it is active, by its own report.
        clear_s: When it was last seen to become idle.
        bucket_s: Content of the bucket, at the time `bucket_at_s`.
        bucket_at_s: See `bucket_s`.
        nodes: Failed nodes that it names.
        reason: Why it is active.
    """

    name: str
    heard_s: float
    ever_heard: bool = False
    reported: bool = False
    silent: bool = False
    active: bool = False
    rises: int = 0
    since_s: float = 0.0
    clear_s: float = 0.0
    bucket_s: float = 0.0
    bucket_at_s: float = 0.0
    nodes: tuple[str, ...] = ()
    reason: str = ""
    incarnation: int = 0

    @property
    def asserted(self) -> bool:
        """Whether it is active by its own word or by its silence, rather than only held."""
        return self.reported or self.silent


MANY_SHARE = 1 / 3
"""Of the detection modules: so many are not silent by chance, each for a reason of its own."""


def said(tracks: tuple[DetectionTrack, ...]) -> frozenset[str]:
    """Return the modules that are active by what they reported, not only because they are silent.

    Where many are silent at once it is what they have in common, and the silence of each means
    what it would report if it could.
    """
    many_are_silent = sum(track.silent for track in tracks) >= MANY_SHARE * len(tracks)
    return frozenset(track.name for track in tracks if track.active and (
        track.reported or not track.silent or many_are_silent))


OVERDUE_SHARE = 0.6
"""Of the silence timeout: older news of a module, and it is overdue; half of that is late. Three
reports fit in before, and its successor has time to be heard after."""


def overdue(tracks: tuple[DetectionTrack, ...], rules: DetectionRules, now: float
            ) -> DetectionTrack | None:
    """Return the one module that is overdue while no other one is late, if there is one."""
    limit_s = OVERDUE_SHARE * rules.silence_timeout_s
    late = [track for track in tracks if now - track.heard_s > limit_s / 2]
    return next((track for track in late if len(late) == 1 and now - track.heard_s > limit_s
                 and track.ever_heard and not track.silent), None)


def hear(track: DetectionTrack, report: DetectionHeard, rules: DetectionRules, now: float
         ) -> DetectionTrack:
    """Take in a report that arrives at `now`; it was true then at the latest."""
    heard_s = max(track.heard_s, min(report.stamp_s, now))
    heard = replace(track, heard_s=heard_s, ever_heard=True, reported=report.active,
                    incarnation=report.incarnation,
                    silent=track.silent and now - heard_s > rules.silence_timeout_s)
    if report.active:
        heard = replace(heard, nodes=report.nodes, reason=report.reason)
    return _follow(track, heard, rules, now, report.since_s)


def pass_time(track: DetectionTrack, rules: DetectionRules, now: float) -> DetectionTrack:
    """Let time pass: find out silence, and let go what has been idle for long enough."""
    patience_s = rules.silence_timeout_s
    if not track.ever_heard:
        patience_s = max(patience_s, rules.startup_grace_s)
    if not track.silent and now - track.heard_s > patience_s:
        silent = replace(
            track, silent=True, reason="silent", nodes=track.nodes if track.reported else ())
        return _follow(track, silent, rules, now, now)
    if track.active and not track.asserted and now - track.clear_s >= release_hold_s(track, rules):
        return replace(track, active=False, nodes=(), reason="")
    return track


def release_hold_s(track: DetectionTrack, rules: DetectionRules) -> float:
    """How long the module must stay idle, from `clear_s` on, before that is believed."""
    bucket_s = _bucket_s(track, rules, track.clear_s)
    return min(max(bucket_s, rules.release_hold_s), rules.release_hold_max_s)


def _follow(before: DetectionTrack, after: DetectionTrack, rules: DetectionRules, now: float,
            since_s: float) -> DetectionTrack:
    """Note a rise or a fall."""
    if after.asserted and not before.asserted:
        bucket_s = _bucket_s(before, rules, now) + rules.release_hold_s
        return replace(
            after, active=True, rises=before.rises + 1, since_s=since_s, bucket_at_s=now,
            bucket_s=min(bucket_s, rules.release_hold_max_s))
    if before.asserted and not after.asserted:
        return replace(after, clear_s=now)
    return after


def _bucket_s(track: DetectionTrack, rules: DetectionRules, now: float) -> float:
    """Content of the bucket now: it loses one portion in `release_hold_max_s`."""
    if rules.release_hold_max_s == 0:
        return 0.0
    leak = rules.release_hold_s / rules.release_hold_max_s
    return max(0.0, track.bucket_s - leak * max(0.0, now - track.bucket_at_s))
