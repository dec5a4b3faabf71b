"""`rampart obstacle`: obstacles in the simulated world.

Place an obstacle in the simulated world, move it, or remove it.

Examples:
  rampart obstacle list
  rampart obstacle add crate 5 -18.5
  rampart obstacle add van -3.2 4 --radius 0.8
  rampart obstacle remove crate
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.cli.output import NoEffectError, UsageError, positive, print_rows, say, unknown
from rampart.cli.session import Latest, Session, connect
from rampart.cli.verbs import JSON, PORT, add_family, add_verb, number, option

_OBSTACLES_PERIOD_S = 1.5
"""Simulated seconds within which the world lists its obstacles (nominally each second)."""


def add(verbs: Any, _formatter: Any, _common: Any) -> None:
    """Add the verbs to the parser."""
    family = add_family(verbs, "obstacle", "place obstacles in the simulated world", __doc__)
    name = option("name", metavar="NAME", help="name of the obstacle")
    add_verb(family, "add", "place or move an obstacle", obstacle_add, PORT, name,
             option("x", type=float, metavar="X", help="east, m"),
             option("y", type=float, metavar="Y", help="north, m"),
             number("--radius", "M", "radius, m (default: 0.4)", 0.4))
    add_verb(family, "remove", "remove an obstacle", obstacle_remove, PORT, name)
    add_verb(family, "list", "list the obstacles", obstacle_list, PORT, JSON)


async def obstacle_list(options: argparse.Namespace) -> int:
    """Print the obstacles.

    List the obstacles with place and radius.

    Examples:
      rampart obstacle list --json
    """
    async with connect(options.port) as session:
        present = await _World(session).obstacles()
    head = ("name", "x_m", "y_m", "radius_m")
    rows = [[getattr(o, name) for name in head] for o in present.values()]
    print_rows(head, rows, [dict(zip(head, row, strict=True)) for row in rows],
               as_json=options.json)
    return 0


async def obstacle_add(options: argparse.Namespace) -> int:
    """Make an obstacle appear, or move it.

    Place an obstacle at (X, Y) of the map frame, in metres, or move it there.

    Examples:
      rampart obstacle add crate 5 -18.5 --radius 0.4
    """
    for name in ("x", "y", "radius"):
        value = getattr(options, name)
        if not math.isfinite(value):
            raise UsageError(f"{name} = {value}: must be a finite number of metres")
    positive("--radius", options.radius)
    order = m.ObstacleCommand(options.name, True, options.x, options.y, options.radius)

    def there(obstacle: m.ObstacleCommand | None) -> bool:
        return obstacle is not None and all(
            math.isclose(getattr(obstacle, name), getattr(order, name), abs_tol=1e-6)
            for name in ("x_m", "y_m", "radius_m"))

    async with connect(options.port) as session:
        await _World(session).change(order, there)
    say(f"obstacle {options.name} at ({options.x:g}, {options.y:g})")
    return 0


async def obstacle_remove(options: argparse.Namespace) -> int:
    """Take an obstacle away.

    Remove an obstacle from the world.

    Examples:
      rampart obstacle remove crate
    """
    async with connect(options.port) as session:
        session.check_may_order()
        world = _World(session)
        present = await world.obstacles()
        if options.name not in present:
            raise unknown("obstacle", options.name, present)
        await world.change(m.ObstacleCommand(options.name, False, 0.0, 0.0, 0.0),
                           lambda obstacle: obstacle is None)
    say(f"obstacle {options.name} removed")
    return 0


class _World:
    """The obstacles of the simulated world, and its diagnostics about this tool's orders."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._listed = Latest[m.ObstacleList]()
        self._complaint = ""
        session.listen(topics.OBSTACLES, self._listed.keep)
        session.listen(bus_topics.DIAGNOSTIC, self._diagnostic)

    def _diagnostic(self, _key: str, _header: Header, report: bm.Diagnostic) -> None:
        if report.offender == self._session.name:
            self._complaint = report.reason

    async def obstacles(self) -> dict[str, m.ObstacleCommand]:
        """Return the obstacles by name.

        Raises:
            NoEffectError: the world does not answer.
        """
        await self._listed.first(self._session.real_s(_OBSTACLES_PERIOD_S))
        return self._present()

    async def change(self, order: m.ObstacleCommand,
                     done: Callable[[m.ObstacleCommand | None], bool]) -> None:
        """Order a change, and wait until the world lists it.

        Raises:
            NoEffectError: the world refuses, or does not answer.
        """
        await self.obstacles()
        changed = await self._session.command(
            topics.OBSTACLE, order,
            lambda: bool(self._complaint) or done(self._present().get(order.name)),
            self._session.real_s(2 * _OBSTACLES_PERIOD_S))
        if self._complaint or not changed:
            raise NoEffectError(f"no effect: {self._complaint or 'the world does not list it'}")

    def _present(self) -> dict[str, m.ObstacleCommand]:
        if self._listed.value is None:
            raise NoEffectError("the world does not answer: it published no list of obstacles")
        return {o.name: o for o in self._listed.value.obstacles if o.present}
