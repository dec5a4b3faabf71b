"""What does a checkpoint cost its node's loop, and what does a respawned node pay to find one?

`python -m benchmarks.checkpoints [DIRECTORY]`: states as the nodes keep them at the end of mission
AB go through `Actor.keep`'s path, store and all, at 50 a second, many more than a node keeps, while
the thread syncs. Prints percentiles in microseconds. The directory should be on
the disk that is meant; by default it is a temporary one in the working directory, for /tmp may be
memory.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import msgspec

from rampart.actors.osmosis.control.following.light_ledger import LightsKept
from rampart.actors.osmosis.control.following.route_control import CONTROL_STATE, ControlKept
from rampart.actors.osmosis.control.mission.mission_state import MISSION_STATE, MissionState
from rampart.actors.osmosis.messages import (
    Goal,
    LightMeasurement,
    LightVerdict,
    MissionPhase,
    Mode,
    Route,
)
from rampart.actors.runtime.checkpoint import Keeper
from rampart.actors.runtime.checkpoint_file import FileCheckpoints

SAVES = 1500
PACE_S = 0.02
OPENINGS = 50

_LIGHTS = tuple(LightMeasurement(f"{row}{n:02}", 201.3 + n, 1.006, LightVerdict.OK)
                for row in "AB" for n in range(1, 12))
_GOALS = tuple(Goal(-22.0 + n, -18.5, Mode.TAXI) for n in range(5))


def mission(number: int) -> MissionState:
    """Return a Mission Manager's state near the end of mission AB; each number another one."""
    return MissionState("run/first", "AB", MissionPhase.RUNNING, _GOALS, 4, float(number),
                        (33.0, 57.0, 21.0, 55.0), _LIGHTS, accepted=("run/first",))


def control(number: int) -> ControlKept:
    """Return Osmosis Control's, on a long route."""
    route = Route("run/first", 4, Mode.TAXI, True,
                  tuple((float(n), n / 3) for n in range(20)), "")
    return ControlKept(LightsKept("run/first", _LIGHTS), route, number / 7, (0.0, 0.0))


def percentiles(times_s: list[float]) -> str:
    """Return median, 99th percentile and maximum in microseconds."""
    ordered = sorted(times_s)
    return "  ".join(f"{1e6 * ordered[int(share * (len(ordered) - 1))]:8.0f}"
                     for share in (0.5, 0.99, 1.0))


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", nargs="?", default=".", metavar="DIRECTORY",
                        help="on the disk that is meant (default: the working directory)")
    chosen = parser.parse_args().directory
    print(f"{'us':<34}{'bytes':>6}    median       99 %       max")
    with tempfile.TemporaryDirectory(dir=chosen) as directory:
        for name, form, make in (("mission_manager", MISSION_STATE, mission),
                                 ("osmosis_control", CONTROL_STATE, control)):
            folder = Path(directory)
            told: list[str] = []
            keeper = Keeper(FileCheckpoints(folder, name, "bench", 1), told.append, time.monotonic,
                            expected=False)
            keeper.kept(form)  # type: ignore[type-var]
            took: list[float] = []
            for number in range(SAVES):
                state = make(number)
                begun_s = time.perf_counter()
                keeper.keep(form, state)  # type: ignore[misc, type-var]
                took.append(time.perf_counter() - begun_s)
                time.sleep(PACE_S)
            size = len(msgspec.msgpack.encode(make(1)))
            print(f"{name + ' keeps its state':<34}{size:>6}  {percentiles(took)}")
            opening: list[float] = []
            for incarnation in range(2, 2 + OPENINGS):
                store = FileCheckpoints(folder, name, "bench", incarnation, syncs=False)
                begun_s = time.perf_counter()
                Keeper(store, told.append, time.monotonic, expected=True).kept(form)  # type: ignore[type-var]
                opening.append(time.perf_counter() - begun_s)
                store.close()
            keeper.close()
            print(f"{name + ' finds it again':<34}{size:>6}  {percentiles(opening)}")
            if told:
                print("\n".join(told))
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
