"""`rampart reset` and `rampart obstacle`: what an operator, or the world, does to a run."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.cli import systems
from rampart.cli.following import stopped_by_signals
from rampart.cli.holdings import Holdings
from rampart.cli.output import NoEffectError, UsageError, print_json, print_table, say, unknown
from rampart.cli.session import Session, connect

T = TypeVar("T")

STUB_DETECTION = "rampart.actors.detection.stub:StubDetection"

_RESET_WAIT_S = 3.0
"""Simulated seconds within which the manager releases a recovery whose cause is gone."""

_OBSTACLES_PERIOD_S = 1.5
"""Simulated seconds within which the world lists its obstacles (nominally each second)."""


def add(verbs: Any, formatter: Any, common: argparse.ArgumentParser) -> None:
    """Add the verbs to the parser."""
    parser = verbs.add_parser(
        "reset", parents=[common], formatter_class=formatter,
        help="release a latched recovery, e.g. the emergency stop",
        description="Release a recovery that stays in force until an operator resets it. Nothing\n"
                    "happens while its cause is still there; the verb then says so and exits 1.\n"
                    "Also lets go of the brake, or ends an order to the Safety Pilot, in place of\n"
                    "somebody who is no recovery module of the system; rampart status says who.",
        epilog="examples:\n  rampart reset RM1\n  rampart reset rampart-4711")
    parser.add_argument("recovery", metavar="NAME", help="e.g. RM1")
    parser.set_defaults(run=lambda options: asyncio.run(reset(options)))

    parser = verbs.add_parser(
        "trigger", parents=[common], formatter_class=formatter,
        help="make the stand-in of a detection module detect",
        description="Make a detection module that is a stand-in (actors.stub) active, for some\n"
                    "simulated seconds. What real modules detect is injected: rampart inject.",
        epilog="examples:\n  rampart trigger D_CURTAIN\n  rampart trigger D_VISION --for 5")
    parser.add_argument("module", metavar="NAME", help="detection module, e.g. D_CURTAIN")
    parser.add_argument("--for", dest="duration", type=float, default=2.0, metavar="S",
                        help="simulated seconds (default 2)")
    parser.set_defaults(run=lambda options: asyncio.run(trigger(options)))

    parser = verbs.add_parser(
        "obstacle", formatter_class=formatter, help="put obstacles in the robot's way",
        description="Put an obstacle into the simulated world, move it, or take it away.",
        epilog="examples:\n  rampart obstacle list\n  rampart obstacle add crate 5 -18.5\n"
               "  rampart obstacle add van -3.2 4 --radius 0.8\n  rampart obstacle remove crate")
    subverbs = parser.add_subparsers(dest="subverb", required=True, metavar="VERB")
    adding = subverbs.add_parser(
        "add", parents=[common], formatter_class=formatter, help="make an obstacle appear",
        description="Make an obstacle appear at (X, Y) of the map frame, metres, or move it there.",
        epilog="examples:\n  rampart obstacle add crate 5 -18.5 --radius 0.4")
    adding.add_argument("name", metavar="NAME")
    adding.add_argument("x", type=float, metavar="X", help="east, m")
    adding.add_argument("y", type=float, metavar="Y", help="north, m")
    adding.add_argument("--radius", type=float, default=0.4, metavar="M", help="default 0.4 m")
    adding.set_defaults(run=lambda options: asyncio.run(obstacle_add(options)))
    removing = subverbs.add_parser(
        "remove", parents=[common], formatter_class=formatter, help="take an obstacle away",
        description="Take an obstacle away.", epilog="examples:\n  rampart obstacle remove crate")
    removing.add_argument("name", metavar="NAME")
    removing.set_defaults(run=lambda options: asyncio.run(obstacle_remove(options)))
    listing = subverbs.add_parser(
        "list", parents=[common], formatter_class=formatter, help="the obstacles there are",
        description="List the obstacles that are there now.",
        epilog="examples:\n  rampart obstacle list --json")
    listing.add_argument("--json", action="store_true", help="print JSON")
    listing.set_defaults(run=lambda options: asyncio.run(obstacle_list(options)))


async def reset(options: argparse.Namespace) -> int:
    """Release a latched recovery."""
    async with connect(options.port) as session:
        known = [r.name for r in systems.load(session.run.system_file).recoveries]
        if options.recovery not in known:
            return await _let_go(session, options.recovery, known)
        latched = _Latest[fm.ManagerStatus]()
        session.listen(ftm_topics.MANAGER_STATUS, ftm_topics.MANAGER_STATUS.at(), latched.keep)
        status = await latched.first(session.real_s(1.0))
        if status is None:
            raise NoEffectError("the FTM Manager does not answer; try again when it is back")
        if options.recovery not in status.latched:
            waiting = ", ".join(status.latched) or "none"
            raise NoEffectError(f"no effect: {options.recovery} is not latched; latched: {waiting}")
        released = await session.command(
            ftm_topics.RESET, fm.Reset(options.recovery, session.name),
            lambda: latched.value is not None and options.recovery not in latched.value.latched,
            session.real_s(_RESET_WAIT_S))
    if not released:
        active = ", ".join(latched.value.active) if latched.value else ""
        raise NoEffectError(f"{options.recovery} was not released; active: {active or 'none'}")
    say(f"{options.recovery} released")
    return 0


async def _let_go(session: Session, name: str, known: list[str]) -> int:
    """Let go in the place of a holder that is no recovery module.

    Raises:
        UsageError: nobody of that name holds anything.
    """
    held = Holdings(session)
    await held.settle()
    what = held.by(name)
    if not what:
        raise unknown("recovery", name, [*known, *held.holders])
    if not await session.command(ftm_topics.RESET, fm.Reset(name, session.name),
                                 lambda: not held.by(name), session.real_s(_RESET_WAIT_S)):
        raise NoEffectError(f"{name} was not made to let go of {' and '.join(held.by(name))}; it "
                            "orders it again and again")
    say(f"{name} holds no longer: {' and '.join(what)}")
    return 0


async def trigger(options: argparse.Namespace) -> int:
    """Make a stand-in detect for a while."""
    if not 0 < options.duration < 1e6:
        raise UsageError(f"--for {options.duration:g}: must be above 0")
    async with connect(options.port) as session:
        spec = systems.load(session.run.system_file)
        stubs = [d.name for d in spec.detections if d.actor == STUB_DETECTION]
        if options.module not in stubs:
            raise unknown("stand-in detection module", options.module, stubs)
        heard = _Latest[fm.DetectionReport]()
        session.listen(ftm_topics.DETECTION, ftm_topics.DETECTION.at(options.module), heard.keep)

        async def bring(state: fm.DetectionState) -> bool:
            active = state is fm.DetectionState.ACTIVE
            return await session.command(
                ftm_topics.STUB_TRIGGER,
                fm.StubTrigger(options.module, active, "triggered by hand"),
                lambda: heard.value is not None and heard.value.state is state,
                session.real_s(1.0))

        if not await bring(fm.DetectionState.ACTIVE):
            raise NoEffectError(f"no effect: {options.module} does not answer")
        say(f"{options.module} detects")
        stop = asyncio.Event()
        with stopped_by_signals(stop), contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), options.duration / session.clock.rate)
        if not await bring(fm.DetectionState.IDLE):
            raise NoEffectError(f"{options.module} did not become idle again")
    say(f"{options.module} is idle again")
    return 0


async def obstacle_list(options: argparse.Namespace) -> int:
    """Print the obstacles."""
    async with connect(options.port) as session:
        present = await _World(session).obstacles()
    if options.json:
        print_json([{"name": o.name, "x_m": o.x_m, "y_m": o.y_m, "radius_m": o.radius_m}
                    for o in present.values()])
    else:
        print_table(("name", "x_m", "y_m", "radius_m"),
                    [(o.name, round(o.x_m, 2), round(o.y_m, 2), o.radius_m)
                     for o in present.values()])
    return 0


async def obstacle_add(options: argparse.Namespace) -> int:
    """Make an obstacle appear."""
    for name in ("x", "y", "radius"):
        value = getattr(options, name)
        if not math.isfinite(value):
            raise UsageError(f"{name} = {value}: must be a finite number of metres")
    if options.radius <= 0:
        raise UsageError(f"--radius {options.radius:g}: must be above 0")
    order = m.ObstacleCommand(options.name, True, options.x, options.y, options.radius)

    def there(obstacle: m.ObstacleCommand | None) -> bool:
        return obstacle is not None and all(
            math.isclose(is_, wanted, abs_tol=1e-6) for is_, wanted in (
                (obstacle.x_m, order.x_m), (obstacle.y_m, order.y_m),
                (obstacle.radius_m, order.radius_m)))

    async with connect(options.port) as session:
        await _World(session).change(order, there)
    say(f"obstacle {options.name} at ({options.x:g}, {options.y:g})")
    return 0


async def obstacle_remove(options: argparse.Namespace) -> int:
    """Take an obstacle away."""
    async with connect(options.port) as session:
        world = _World(session)
        present = await world.obstacles()
        if options.name not in present:
            raise unknown("obstacle", options.name, present)
        await world.change(m.ObstacleCommand(options.name, False, 0.0, 0.0, 0.0),
                           lambda obstacle: obstacle is None)
    say(f"obstacle {options.name} removed")
    return 0


class _Latest(Generic[T]):
    """The newest message of a topic."""

    def __init__(self) -> None:
        self.value: T | None = None
        self._heard = asyncio.Event()

    def keep(self, _key: str, _header: Header, body: T) -> None:
        self.value = body
        self._heard.set()

    async def first(self, timeout_s: float) -> T | None:
        """Return the newest message, or wait for the first one, at most real seconds."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._heard.wait(), timeout_s)
        return self.value


class _World:
    """The simulated world's obstacles, and its complaints."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._listed = _Latest[m.ObstacleList]()
        self._complaint = ""
        session.listen(topics.OBSTACLES, topics.OBSTACLES.at(), self._listed.keep)
        session.listen(bus_topics.DIAGNOSTIC, bus_topics.DIAGNOSTIC.pattern, self._diagnostic)

    def _diagnostic(self, _key: str, _header: Header, report: bm.Diagnostic) -> None:
        if report.offender == self._session.name:
            self._complaint = report.reason

    async def obstacles(self) -> dict[str, m.ObstacleCommand]:
        """Return the obstacles that are there.

        Raises:
            NoEffectError: the world does not answer.
        """
        await self._listed.first(self._session.real_s(_OBSTACLES_PERIOD_S))
        return self._present()

    async def change(
        self, order: m.ObstacleCommand, done: Callable[[m.ObstacleCommand | None], bool]
    ) -> None:
        """Order a change and wait until it shows.

        Raises:
            NoEffectError: the world refused, or does not answer.
        """
        await self.obstacles()
        changed = await self._session.command(
            topics.OBSTACLE, order,
            lambda: bool(self._complaint) or done(self._present().get(order.name)),
            self._session.real_s(2 * _OBSTACLES_PERIOD_S))
        if self._complaint or not changed:
            raise NoEffectError(f"no effect: {self._complaint or 'the world did not take it'}")

    def _present(self) -> dict[str, m.ObstacleCommand]:
        if self._listed.value is None:
            raise NoEffectError("the world does not answer: no list of obstacles was heard")
        return {o.name: o for o in self._listed.value.obstacles if o.present}
