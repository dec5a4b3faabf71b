"""The quadrotor's application: its topics, model and faults."""

from __future__ import annotations

from quadrotor import topics as t
from rampart import Application, Topic


class Quadrotor(Application):
    """The application of the quadrotor's system."""

    topics = tuple(topic for topic in vars(t).values() if isinstance(topic, Topic))
    model = "quadrotor.physics:QuadrotorModel"
    faults = "quadrotor.faults:QuadrotorFaults"
    examples = (("--virtual --fault weak-rotor@10", "a rotor loses 30 % of its thrust"),
                ("--virtual --fault kill:pilot@15", "the pilot dies in flight"))
