"""A robot with topics of its own: the shipped one that carries something, in a spec and actors."""

from pathlib import Path
from typing import Any

import msgspec

from rampart import Message, Qos, Topic
from rampart.actors.runtime.actor import Actor, Header, every, on
from rampart.manager.spec.tables import Name, NonNegative
from tests import ROOT


class Load(Message, frozen=True):
    """What it carries."""

    mass_kg: float


class Axle(msgspec.Struct, array_like=True):
    """One axle, on the way without the names of its fields."""

    speed_radps: float


LOAD = Topic("porter/load", Load, Qos.SENSOR, 10, "base_link", "Mass on the platform.")
AXLE = Topic("porter/axle/{name}", Axle, Qos.STATE, 2, "base_link", "Speed of axle {name}.")


class Platform(Actor):
    """Weighs, and turns."""

    class Parameters(Actor.Parameters, frozen=True):
        """What the platform is like.

        Attributes:
            axles: their names.
            mass_kg: what it carries.
        """

        axles: tuple[Name, ...] = ("front",)
        mass_kg: NonNegative = 20.0

    parameters: Parameters
    outputs = (LOAD, AXLE)

    @classmethod
    def output_names(
        cls, topic: Topic[Any], name: str, parameters: Parameters
    ) -> tuple[str, ...]:
        """Name the axles."""
        return parameters.axles if topic is AXLE else (name,)

    @every(0.1)
    def weigh(self) -> None:
        self.publish(LOAD, Load(self.parameters.mass_kg))


class Display(Actor):
    """Shows the axles."""

    @on(AXLE)
    def axle(self, message: Axle, _header: Header) -> None:
        pass


def write_porter_system(directory: Path) -> Path:
    """Write the shipped system with two more nodes."""
    text = (ROOT / "systems" / "osmosis.toml").read_text(encoding="utf-8")
    for name, actor, parameters in (
            ("platform", "Platform", '{ axles = ["front", "rear"] }'),
            ("display", "Display", "{}")):
        text += (f'\n[[node]]\nname = "{name}"\nactor = "tests.porter_actors:{actor}"\n'
                 f'kind = "non-control"\nparameters = {parameters}\n')
    file = directory / "porter.toml"
    file.write_text(text, encoding="utf-8")
    return file
