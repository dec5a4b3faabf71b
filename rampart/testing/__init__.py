"""Tests of a robot: actors in virtual time, real runs, faults; see docs/how-to/testing.md.

Nothing here knows a robot. Failed expectations are `AssertionError`s; pytest is not needed.
"""

from rampart.testing.ports import free_base_port, free_port
from rampart.testing.real_run import HEEDS_SIGNALS, RealRun
from rampart.testing.timeline import Ear, play, table, wake
from rampart.testing.virtual import Heard, VirtualSystem, run, turns, virtual_run
from rampart.testing.waiting import eventually, wait_until

__all__ = [
    "HEEDS_SIGNALS", "Ear", "Heard", "RealRun", "VirtualSystem", "eventually", "free_base_port",
    "free_port", "play", "run", "table", "turns", "virtual_run", "wait_until", "wake",
]
