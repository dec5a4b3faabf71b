"""The application of Osmosis: an airport and a mission there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from rampart.actors.osmosis import topics
from rampart.actors.runtime.application import Application

if TYPE_CHECKING:
    from rampart.actors.osmosis.airport.model import Airport, Mission, WorldTruth

_AIRPORT = "airport"
"""Folder of the airport's files in a recording."""

class Osmosis(Application):
    """The airport and the mission, for the nodes of Osmosis.

    Attributes:
        airport: the airport on the controller's map.
        mission: the mission.
        world: differences of the world from the controller's map.
    """

    class Options(Application.Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
        """Options of a run of Osmosis."""

        airport: Annotated[str, msgspec.Meta(
            description="shipped airport, a .toml, or a .graph with its image beside it",
            extra={"metavar": "NAME|FILE", "file": True})]
        mission: Annotated[str, msgspec.Meta(
            description="mission of the airport, or a file with lines x=…,y=…,taxi=…",
            extra={"metavar": "NAME|FILE", "file": True, "campaign": "A"})]
        obstacles: Annotated[int, msgspec.Meta(
            ge=0, description="number of the airport's obstacles on the way",
            extra={"metavar": "N", "campaign": "0,2"})] = 0

    topics = topics.ROBOT
    views = "rampart.actors.osmosis.views:OsmosisViews"
    lines = "rampart.cli.osmosis.lines:OsmosisLines"
    model = "rampart.sim.osmosis.camera:AirportModel"
    faults = "rampart.sim.osmosis.trial.faults:OsmosisFaults"
    observer = "rampart.sim.osmosis.trial.mission_trial:OsmosisObserver"
    trial = "rampart.sim.osmosis.trial.mission_trial:MissionTrial"
    examples = (
        ("--mission A --obstacles 2", "two obstacles on the way"),
        ("--virtual --fault kill:osmosis_control@30 --fault gps-bias@goal2+5", "two faults"),
        ("--airport my/airport.graph --mission my/MISSION_A.miss", "your airport"),
    )
    options: Options

    def __init__(self, options: Options) -> None:
        from rampart.actors.osmosis.airport import formats  # noqa: PLC0415 heavy for a tool

        super().__init__(options)
        self.airport, self.world = formats.load_with_truth(options.airport)
        self.mission: Mission = formats.load_mission(options.mission, self.airport)
        if options.obstacles > len(self.airport.obstacles):
            raise ValueError(f"obstacles = {options.obstacles}: expected at most "
                             f"{len(self.airport.obstacles)} on {self.airport.name}")

    @classmethod
    def on_map(cls, airport: Airport, mission: Mission | None = None,
               world: WorldTruth | None = None) -> Osmosis:
        """Return the application for a loaded airport, with a mission or without."""
        from rampart.actors.osmosis.airport.model import Mission, WorldTruth  # noqa: PLC0415 heavy

        found = cls.__new__(cls)
        found.options = cls.Options(airport=airport.source, mission="")
        found.airport, found.world = airport, world or WorldTruth()
        found.mission = mission or Mission("", ())
        return found

    def documents(self) -> list[tuple[str, Path]]:
        """Return the files of the airport and of the mission, if it has one."""
        from rampart.actors.osmosis.airport.formats import files_of  # noqa: PLC0415 as above

        found = [(f"{_AIRPORT}/{path.name}", path) for path in files_of(Path(self.airport.source))]
        mission = Path(self.options.mission)
        if mission.suffix in (".miss", ".toml") and mission.is_file():
            found.append((f"mission/{mission.name}", mission))
        return found

    @classmethod
    def restored(cls, directory: Path) -> Application:
        """Return the application on the airport of a recording, without a mission.

        Raises:
            OSError, ValueError: the recording has no valid airport.
        """
        from rampart.actors.osmosis.airport.formats import load_airport  # noqa: PLC0415 as above

        found = sorted((directory / _AIRPORT).glob("*.toml")) or sorted(
            (directory / _AIRPORT).glob("*.graph"))
        if not found:
            raise ValueError("no airport in the recording")
        return cls.on_map(load_airport(found[0]))

    @classmethod
    def said(cls, name: str, value: Any) -> str:
        """Return an option's value as text."""
        if name == "obstacles":
            return f"{value or 'no'} obstacle{'' if value == 1 else 's'}"
        return super().said(name, value)

    def world_parameters(self) -> Mapping[str, Any]:
        """Return the number of obstacles for the world."""
        return {"obstacles": self.options.obstacles}
