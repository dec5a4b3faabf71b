"""Nodes that fail whenever they start, for a while, and are well after it."""

from __future__ import annotations

from pathlib import Path

import msgspec

from rampart.actors.detection.freshness import Freshness
from rampart.actors.osmosis.control.pilot.safety_pilot import SafetyPilot
from rampart.actors.runtime.actor import Actor
from rampart.manager.actor import FtmManager
from rampart.manager.spec.tables import Supervision
from tests import ROOT

SICK_S = (14.0, 40.0)
"""Simulated seconds, far longer than it takes to be given up."""

SOON = Supervision(intensity=8, period_s=6.0, backoff_max_s=0.2, attempt_s=1.0, attempt_max_s=4.0)
"""A supervisor that gives up sooner than the usual one."""

_SOON = "\n[supervision]\n" + "".join(
    f"{name} = {value}\n" for name, value in msgspec.structs.asdict(SOON).items())

class Sick(Actor):
    def on_start(self) -> None:
        if SICK_S[0] <= self.clock.now() < SICK_S[1]:
            raise RuntimeError("sick")
        super().on_start()


class SickPilot(Sick, SafetyPilot):
    pass


class SickModule(Sick, Freshness):
    pass


class SickManager(Sick, FtmManager):
    pass


ACTORS = {
    "safety_pilot": ("rampart.actors.osmosis.control.pilot.safety_pilot:SafetyPilot", SickPilot),
    "DM2": ("rampart.actors.detection.freshness:Freshness", SickModule),
    "ftm_manager": ("rampart.manager.actor:FtmManager", SickManager),
}


def write_sick_system(directory: Path, node: str) -> Path:
    """Write the paper's system in which one node is sick for a while, and soon given up."""
    text = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
    usual, sick = ACTORS[node]
    assert f'"{usual}"' in text
    file = directory / "sick.toml"
    file.write_text(text.replace(f'"{usual}"', f'"{sick.__module__}:{sick.__name__}"', 1)
                    + _SOON, encoding="utf-8")
    return file
