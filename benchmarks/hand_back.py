"""How soon does a host that was cut off run its own nodes again?

The full system in two network namespaces, page and some modules on the second host, joined by a
line of 50 ms with 5 % loss (`tests/whole/network.py`). The line is cut again and again; taken is
the time from the cut until all nodes of the second host run on the first, and from when the line
is there again until all of them run on the second, and none on the first. Needs the rights to make
namespaces.

    python -m benchmarks.hand_back
    python -m benchmarks.hand_back --cut 30 --tries 3
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rampart.testing import RealRun
from tests.two_hosts import ON_GROUND, two_hosts
from tests.whole.network import Line, Network, network, why_not

_BAD = Line(delay_s=0.05, jitter_s=0.01, loss=0.05)
_BACK = "supervisor_ground back"
_BETWEEN_S = 65.0  # lost again sooner, it would flap and be given back later
_LONGEST_S = 30.0


def started(net: Network, host: str, folder: Path, spec: Path, *arguments: str) -> RealRun:
    """Return a host's part of a run, to be entered."""

    class OnHost(RealRun):
        command = net.command(host, sys.executable, "-P", "-m", "rampart.cli.run")

    folder.mkdir()
    where = ["--host", host] if host != "robot" else []
    return OnHost(folder, spec, *where, "--no-keys", *arguments)


def took_s(run: RealRun, condition: Callable[[], bool]) -> float:
    """Wait for a condition; return how long that took."""
    begun_s = time.monotonic()
    run.wait_until(condition, _LONGEST_S, "not in time")
    return time.monotonic() - begun_s


def is_taken_over(robot: RealRun) -> bool:
    """Whether the first host runs what the second had."""
    return None not in map(robot.pid, ON_GROUND)


def give_back(net: Network, robot: RealRun, ground: RealRun) -> tuple[float, float]:
    """Mend the line; return after how long the first host counts the second as there, seconds.

    And after how long only the second one runs what is its own, in processes begun since.
    """
    pids = {name: ground.pid(name) for name in ON_GROUND}
    told = robot.story.count(_BACK)
    net.line = _BAD
    heard_s = took_s(robot, lambda: robot.story.count(_BACK) > told)
    return heard_s, heard_s + took_s(robot, lambda: not any(map(robot.pid, ON_GROUND)) and all(
        ground.pid(name) not in {None, pids[name]} for name in ON_GROUND))


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cut", type=float, default=8.0, metavar="S",
                        help="how long the line is cut (default: 8)")
    parser.add_argument("--tries", type=int, default=6, metavar="N", help="how often (default: 6)")
    options = parser.parse_args()
    if why_not():
        print(f"no two hosts here: {why_not()}", file=sys.stderr)
        return 2
    over, back = [], []
    with tempfile.TemporaryDirectory() as place, network(["robot", "ground"]) as net:
        folder = Path(place)
        spec = folder / "two.toml"
        spec.write_text(two_hosts(net.addresses), encoding="utf-8")
        with (started(net, "ground", folder / "g", spec) as ground,
              started(net, "robot", folder / "r", spec, "--mission", "AB") as robot):
            robot.wait_for("goal 1/", 60)
            net.line = _BAD
            for number in range(1, options.tries + 1):
                time.sleep(_BETWEEN_S)
                net.line = Line(is_cut=True)
                begun_s = time.monotonic()
                over.append(took_s(robot, lambda: is_taken_over(robot)))
                time.sleep(max(begun_s + options.cut - time.monotonic(), 0.0))
                heard_s, back_s = give_back(net, robot, ground)
                back.append(back_s)
                print(f"{number}: taken over after {over[-1]:.2f} s; the host counts as there "
                      f"after {heard_s:.2f} s, has its own after {back_s:.2f} s", flush=True)
    for what, seen in (("taken over", over), ("given back", back)):
        print(f"{what} after a cut of {options.cut:g} s: {statistics.median(seen):.2f} s at the "
              f"median, {min(seen):.2f} to {max(seen):.2f}, {len(seen)} tries")
    return 0


if __name__ == "__main__":
    sys.exit(main())
