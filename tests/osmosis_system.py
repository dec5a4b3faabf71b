"""The shipped system, and systems in virtual time whose actors know of a place and a mission."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeVar

from rampart import Actor, Application, systems
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.runtime.run_context import NO_SYSTEM, RunContext
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.web.access import PagePlan
from rampart.manager.spec.specification import SystemSpec, parse_specification
from rampart.testing import VirtualSystem
from tests.virtual_time import Test, within

A = TypeVar("A", bound=Actor)

COMMAND = {"topic": "control/command", "subject": "command"}
POSE = {"topic": "localization/pose", "subject": "localization"}
"""What `Freshness` of DM2 and DM6 hears."""


@cache
def shipped_system() -> SystemSpec:
    """Return the spec of the shipped system."""
    path = systems.SHIPPED / "paper.toml"
    return parse_specification(path.read_text(), path.name)


def run_context(*, system: SystemSpec = NO_SYSTEM, document: Any = None, adapted: Any = None,
                airport: Any = None, mission: Any = None, world: Any = None, **plan: Any
                ) -> RunContext:
    """Return what actors have in common in a test; `plan` are fields of the `RunPlan`.

    Those that begin with `hmi_` are of its page.
    """
    page = {name: plan.pop(name) for name in [*plan] if name.startswith("hmi_")}
    plan["page"] = PagePlan(**{name.removeprefix("hmi_"): page[name] for name in page})
    application = Osmosis.on_map(airport, mission, world) if airport else Application()
    return RunContext(RunPlan(**plan), system, document or {}, application, adapted)


class System(VirtualSystem):
    """Actors that know of `run_context(**known)`."""

    def __init__(self, **known: Any) -> None:
        super().__init__(run_context(**known), topics=topics.ROBOT)

    def start(self, name: str, cls: type[A], **parameters: Any) -> A:
        """Start an actor that can act on the system, `around` it."""
        actor = super().start(name, cls, **parameters)
        actor.around = self
        return actor


def in_system(**known: Any) -> Callable[[Test], Test]:
    """Make a test of a coroutine function, in virtual time; it gets a `System(**known)` first."""
    return within(partial(System, **known))
