"""`rampart reset`, and the old verb `rampart trigger`."""

from __future__ import annotations

import argparse
import asyncio
from typing import Any

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.cli import systems
from rampart.cli.following import stopped_by_signals
from rampart.cli.output import NoEffectError, positive, say, unknown
from rampart.cli.session import Latest, Session, connect, pause
from rampart.cli.verbs import PORT, add_verb, option

STUB_DETECTION = "rampart.actors.detection.stub:StubDetection"

_RESET_WAIT_S = 3.0
"""Simulated seconds within which the manager releases a recovery whose cause is gone."""

_HOLDS_S = 0.3
"""Simulated seconds within which each node repeats its holders (nominally each 0.2 s)."""

_NODES = 16
"""Nodes that can be held, at most."""


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    add_verb(verbs, "reset", "release a latched recovery", reset, PORT,
             option("recovery", metavar="NAME",
                    help="a recovery module, for example RM1, or another holder"))
    add_verb(verbs, "trigger", "", trigger, PORT,
             option("module", metavar="NAME", help="detection module, e.g. D_LEVEL"),
             option("--for", dest="duration", type=float, default=2.0, metavar="S",
                    help="simulated seconds (default 2)"), hidden=True)


async def reset(options: argparse.Namespace) -> int:
    """Release a latched recovery.

    Release a recovery that stays in force until an operator resets it: it is
    latched, or one of its mechanisms clears by operator. While its cause persists,
    or if a mechanism never clears, it is not released, and the exit code is 1.
    `rampart status` shows how each clears. The verb also ends the hold of a client
    that is not a recovery module, for example on the brake; `rampart status` lists
    such holders.

    Examples:
      rampart reset RM1
      rampart reset rampart-4711
    """
    async with connect(options.port) as session:
        session.check_may_order()
        known = [r.name for r in systems.load(session.run.system_file).recoveries]
        if options.recovery not in known:
            return await _let_go(session, options.recovery, known)
        latched = Latest[fm.ManagerStatus]()
        session.listen(ftm_topics.MANAGER_STATUS, latched.keep)
        status = await latched.first(session.real_s(1.0))
        if status is None:
            raise NoEffectError("the FTM Manager does not answer; try again when it is back")
        if options.recovery not in status.latched:
            waiting = ", ".join(status.latched) or "none"
            raise NoEffectError(f"no effect: {options.recovery} is not latched; latched: {waiting}")
        refusals: list[str] = []

        def keep(_key: str, _header: Header, body: bm.Diagnostic) -> None:
            if body.context == fm.RESET_REFUSED and body.offender == options.recovery:
                refusals.append(body.reason)

        session.listen(bus_topics.DIAGNOSTIC, keep)

        def is_released() -> bool:
            return latched.value is not None and options.recovery not in latched.value.latched

        await session.command(
            ftm_topics.RESET, fm.Reset(options.recovery, session.name),
            lambda: is_released() or bool(refusals), session.real_s(_RESET_WAIT_S))
    if refusals:
        raise NoEffectError(f"{options.recovery} was not released: {refusals[0]}")
    if not is_released():
        active = ", ".join(latched.value.active) if latched.value else ""
        raise NoEffectError(f"{options.recovery} was not released; active: {active or 'none'}")
    say(f"{options.recovery} released")
    return 0


async def _let_go(session: Session, name: str, known: list[str]) -> int:
    """Release what a holder holds that is not a recovery module."""
    held = Holdings(session)
    await held.settle()
    what = held.by(name)
    if not what:
        raise unknown("recovery", name, [*known, *held.holders])
    if not await session.command(ftm_topics.RESET, fm.Reset(name, session.name),
                                 lambda: not held.by(name), session.real_s(_RESET_WAIT_S)):
        raise NoEffectError(f"{name} still holds {' and '.join(held.by(name))}; it repeats its "
                            "order")
    say(f"{name} released: {' and '.join(what)}")
    return 0


async def trigger(options: argparse.Namespace) -> int:
    """Activate a stand-in.

    Activate a stand-in for a detection module (`detection.stub`) for some simulated
    seconds. For other detection modules, inject a fault: rampart inject.

    Examples:
      rampart inject trigger:D_LEVEL
      rampart inject trigger:D_VISION --for 5
    """
    positive("--for", options.duration, below=1e6)
    async with connect(options.port) as session:
        spec = systems.load(session.run.system_file)
        stubs = [d.name for d in spec.detections if d.actor == STUB_DETECTION]
        if options.module not in stubs:
            raise unknown("stand-in detection module", options.module, stubs)
        report = Latest[fm.DetectionReport]()
        session.listen(ftm_topics.DETECTION, report.keep,
                       ftm_topics.DETECTION.at(options.module))

        async def bring(state: fm.DetectionState) -> bool:
            return await session.command(
                ftm_topics.STUB_TRIGGER, fm.StubTrigger(
                    options.module, state is fm.DetectionState.ACTIVE, "triggered by hand"),
                lambda: report.value is not None and report.value.state is state,
                session.real_s(1.0))

        if not await bring(fm.DetectionState.ACTIVE):
            raise NoEffectError(f"no effect: {options.module} does not answer")
        say(f"{options.module} detects")
        stop = asyncio.Event()
        with stopped_by_signals(stop):
            await pause(stop, options.duration / session.clock.rate)
        if not await bring(fm.DetectionState.IDLE):
            raise NoEffectError(f"{options.module} did not become idle again")
    say(f"{options.module} is idle again")
    return 0


class Holdings:
    """What holders hold that are not recovery modules, from now on.

    Args:
        session: the connection to the run.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._held: Remembered[str, fm.Holds] = Remembered(_NODES)
        session.listen(ftm_topics.HOLDS, self._keep)

    def _keep(self, _key: str, header: Header, body: fm.Holds) -> None:
        self._held[header.source] = body

    async def settle(self) -> None:
        """Wait until each node has repeated its holders."""
        await asyncio.sleep(self._session.real_s(_HOLDS_S))

    def by(self, name: str) -> tuple[str, ...]:
        """Return what a client holds."""
        return tuple(holds.what for holds in self._held.values() if name in holds.holders)

    @property
    def holders(self) -> dict[str, tuple[str, ...]]:
        """Holder → what it holds."""
        names = dict.fromkeys(name for holds in self._held.values() for name in holds.holders)
        return {name: self.by(name) for name in names}
