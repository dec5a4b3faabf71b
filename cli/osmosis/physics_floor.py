"""The floor of `rampart bench` that this robot brings: a step of its world's physics alone."""

from __future__ import annotations

import mujoco

from rampart.actors.osmosis.airport.formats import load_airport
from rampart.cli.bench.floors import Physics
from rampart.sim.osmosis.scene import Scene

_WHEELS_RADPS = 5.0
"""Of all four: straight on."""


def mj_step() -> Physics:
    """Return a step of the shipped airport: the robot drives, and no sensor is read."""
    scene = Scene(load_airport("vallombre"))
    scene.data.ctrl[:] = _WHEELS_RADPS
    return Physics("osmosis", scene.model.opt.timestep,
                   lambda: mujoco.mj_step(scene.model, scene.data))
