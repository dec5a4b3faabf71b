"""What the arbiter believes about one detection module.

Belief differs from the last report in three ways.

*Silence counts as active*, since a dead module cannot report its death. A module is silent if its
last report is older than `silence_timeout_s`, for whatever reason. The age is that of the report,
not of its arrival: a repeated old report is silence.

*A module whose reports do not arrive is replaced* once, well before its silence counts (`overdue`):
its reports may be lost while its heartbeats are not. If others are late as well, the cause is the
machine or the reader, and none is replaced.

*Active at once, idle after a hold.* A flapping module must not start and release a recovery with
every flap. The hold is a leaky bucket: each rise adds `release_hold_s`, and such a portion leaks
out in `release_hold_max_s`. Therefore

* flaps closer together than `release_hold_max_s` fill the bucket; the hold outgrows the gaps
  between them, and the flapping counts as one long activity;
* flaps further apart do not add up, and one release per `release_hold_max_s` is harmless;
* the bucket holds at most `release_hold_max_s`, so the recovery is released for certain that long
  after the last flap.

A single fault finds the bucket empty and is held for `release_hold_s`. After a finished repair
there is no hold (see `Arbiter`).
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace


class DetectionHeard(msgspec.Struct, frozen=True, tag=True):
    """Input: a report of a detection module, active or idle since `since_s`.

    `nodes` are failed nodes. `stamp_s` is the time stamp of the report, infinite for now.
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
        heard_s: Time stamp of its newest report; before the first, when its time began to run.
        ever_heard: It has reported since the arbiter started.
        reported: It is active by its last report.
        silent: Its last report is too old.
        active: The arbiter takes it for active.
        rises: How often it became active.
        since_s: Since when it is active, by its own report.
        clear_s: When it last became idle.
        bucket_s: Content of the bucket at the time `bucket_at_s`.
        bucket_at_s: See `bucket_s`.
        nodes: Failed nodes that it names.
        incarnation: Of its newest report; 0 before the first.
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
        """Whether it is active by its report or by its silence, rather than only held."""
        return self.reported or self.silent


MANY_SHARE = 1 / 3
"""Share of the detection modules that are not silent at once by chance."""


def reporting(tracks: tuple[DetectionTrack, ...]) -> frozenset[str]:
    """Return the modules that are active by their report, not only by their silence.

    If many are silent at once, they have a common cause, and their silence counts as a report.
    """
    many_are_silent = sum(track.silent for track in tracks) >= MANY_SHARE * len(tracks)
    return frozenset(track.name for track in tracks if track.active and (
        track.reported or not track.silent or many_are_silent))


OVERDUE_SHARE = 0.6
"""Share of the silence timeout after which a module is overdue; at half of it the module is late.
Three reports fit in before, and its successor has time to report after."""


def overdue(tracks: tuple[DetectionTrack, ...], rules: DetectionRules, now: float
            ) -> DetectionTrack | None:
    """Return the module that is overdue while no other is late, if there is one."""
    limit_s = OVERDUE_SHARE * rules.silence_timeout_s
    late = [track for track in tracks if now - track.heard_s > limit_s / 2]
    return next((track for track in late if len(late) == 1 and now - track.heard_s > limit_s
                 and track.ever_heard and not track.silent), None)


def hear(track: DetectionTrack, report: DetectionHeard, rules: DetectionRules, now: float
         ) -> DetectionTrack:
    """Return the track after a report that arrives at `now`."""
    heard_s = max(track.heard_s, min(report.stamp_s, now))
    heard = replace(track, heard_s=heard_s, ever_heard=True, reported=report.active,
                    incarnation=report.incarnation,
                    silent=track.silent and now - heard_s > rules.silence_timeout_s)
    if report.active:
        heard = replace(heard, nodes=report.nodes, reason=report.reason)
    return _follow(track, heard, rules, now, report.since_s)


def pass_time(track: DetectionTrack, rules: DetectionRules, now: float) -> DetectionTrack:
    """Return the track as of `now`: silent after the timeout, idle after the hold."""
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
    """Return how long the module must stay idle after `clear_s` to count as idle."""
    bucket_s = _bucket_s(track, rules, track.clear_s)
    return min(max(bucket_s, rules.release_hold_s), rules.release_hold_max_s)


def _follow(before: DetectionTrack, after: DetectionTrack, rules: DetectionRules, now: float,
            since_s: float) -> DetectionTrack:
    """Return the track `after` with a rise or a fall noted."""
    if after.asserted and not before.asserted:
        bucket_s = _bucket_s(before, rules, now) + rules.release_hold_s
        return replace(
            after, active=True, rises=before.rises + 1, since_s=since_s, bucket_at_s=now,
            bucket_s=min(bucket_s, rules.release_hold_max_s))
    if before.asserted and not after.asserted:
        return replace(after, clear_s=now)
    return after


def _bucket_s(track: DetectionTrack, rules: DetectionRules, now: float) -> float:
    """Return the content of the bucket now: it loses one portion in `release_hold_max_s`."""
    if rules.release_hold_max_s == 0:
        return 0.0
    leak = rules.release_hold_s / rules.release_hold_max_s
    return max(0.0, track.bucket_s - leak * max(0.0, now - track.bucket_at_s))
