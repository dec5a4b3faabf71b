"""The faults that the operator's page offers by name, as plain data for the plan of a run.

Those of the catalogue and of the actuators. A crash is a button of the node, and any topic can be
disturbed as MODE:TOPIC, which the page puts together itself.
"""

from __future__ import annotations

import msgspec

from rampart.actors.ftm.messages import FaultOrder, NamedFault
from rampart.actors.osmosis import topics
from rampart.sim.faults.faults import CATALOGUE
from rampart.sim.faults.scenario import ACTUATOR_FAULTS, OnActuators, PlannedFault, action_of
from rampart.sim.osmosis.robot import WHEEL_NAMES

_TITLES = {
    "stuck-wheel": "the {} wheel is stuck",
    "weak-wheel": "the {} wheel has a fifth of its torque and speed left",
    "brake-failure": "the brakes do not brake",
}


def offered_faults() -> tuple[NamedFault, ...]:
    """Return all of them, in the order in which they are to be shown."""
    on_topics = tuple(
        NamedFault(f.name, f.title, f.group, f.duration_s, injections=f.orders(""))
        for f in CATALOGUE.values())
    return (*on_topics, *(_on_actuators(name) for name in _actuator_names()))


def _actuator_names() -> list[str]:
    return [f"{kind}:{wheel.replace(' ', '-')}" if "wheel" in kind else kind
            for kind in ACTUATOR_FAULTS for wheel in (WHEEL_NAMES if "wheel" in kind else ("",))]


def _on_actuators(name: str) -> NamedFault:
    action = action_of(PlannedFault(name), "", ())
    if not isinstance(action, OnActuators):
        raise TypeError(f"{name} is no fault of the actuators")
    kind, _, wheel = name.partition(":")
    return NamedFault(name, _TITLES[kind].format(wheel.replace("-", " ")), "actuator",
                      action.order.duration_s, orders=(FaultOrder(
                          topics.ACTUATOR_FAULT.key,
                          msgspec.json.encode(action.order).decode()),))
