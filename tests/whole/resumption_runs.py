"""Runs of which the launcher is killed at a random moment, the last write of a state is cut, and
that are resumed; and what each of them has to show.

`python -m tests.whole.resumption_runs FIRST_SEED RUNS [PORT]` prints one line for each.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rampart.actors.osmosis.control.following.route_control import CONTROL_STATE
from rampart.actors.osmosis.control.mission.mission_state import MISSION_STATE
from rampart.actors.runtime.checkpoint_file import files_of, read
from tests import ROOT
from tests.whole.checkpoint_runs import SHORT_LIGHTS, write_short_mission

RATE = 2
"""The whole system takes a core at this rate: what runs beside it finds the other one."""
LASTS_S = 31.0
"""Real seconds that a run takes at most from its start to the end of its mission."""

STATES = ("mission_manager", "graph_planner", "osmosis_control", "simulator", "ftm_manager")


def started(folder: Path, port: int, *options: str, **how: Any) -> subprocess.Popen[str]:
    """Start a run, or go on with one."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--json", "--port", str(port),
         *options], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **how)


def first_part(folder: Path, port: int) -> subprocess.Popen[str]:
    """Start the first part of a run, with its report in `folder/report`."""
    return started(folder, port, "--mission", str(write_short_mission(folder)), "--rate", str(RATE),
                   "--report", str(folder / "report"))


def resumed(folder: Path, port: int, which: str) -> tuple[int, dict[str, Any], str]:
    """Resume a run to its end; return exit code, result, and what it told."""
    run = started(folder, port, "--resume", which)
    out, told = run.communicate(timeout=150)
    return run.returncode, json.loads(out.splitlines()[-1]) if out.strip() else {}, told


def cut_last_write(report: Path, node: str) -> bool:
    """Cut the newest state of a node short, as a loss of power may; return if there was one."""
    files = files_of(report / "checkpoints", node)
    if not files:
        return False
    file = files[max(files)]
    if size := file.stat().st_size:
        os.truncate(file, size - 7)
    return bool(size)


def wrongs(report: Path, code: int, result: dict[str, Any], told: str) -> list[str]:
    """Return what is wrong with a resumed run, one line each."""
    if (code, result.get("mission"), result.get("safety")) != (0, "success", "safe"):
        return [f"code {code}, {result.get('mission')}, {result.get('safety')}: "
                f"{result.get('reasons')}\n{told}"]
    seen = {light["name"]: light["verdict"] for light in result["lights"]
            if light["verdict"] != "not measured"}
    wrong = [] if seen == SHORT_LIGHTS else [f"lights {seen}"]
    run_id = Path(result["report"]).stem.removeprefix("inspection-")
    record = json.loads(Path(result["record"]).read_text(encoding="utf-8"))
    for node, form, lights_of in (
            ("mission_manager", MISSION_STATE, lambda state: state.lights),
            ("osmosis_control", CONTROL_STATE, lambda state: state.lights.measured)):
        newest = read(report / "checkpoints", node, run_id).records[0]
        kept = lights_of(form.decode(newest.version, newest.state))
        if sorted(light.light for light in kept) != sorted(SHORT_LIGHTS):
            wrong.append(f"lights of {node}: {[light.light for light in kept]}")
        values = {light["name"]: light["intensity_cd"] for light in record["lights"]}
        wrong += [f"{node}: light {light.light} was measured twice" for light in kept
                  if light.intensity_cd != values[light.light]]
    if len(record["steps"]) != sum(step["reached_s"] is not None for step in record["steps"]):
        wrong.append(f"steps {record['steps']}")
    return wrong


def one(folder: Path, seed: int, port: int) -> tuple[list[str], str]:
    """Have one run cut off and resumed; return what is wrong, and a line on what was done."""
    dice = random.Random(seed)
    run = first_part(folder, port)
    moment_s = dice.uniform(3.0, LASTS_S)
    time.sleep(moment_s)
    if run.poll() is not None:
        told = run.communicate()[1]
        return [told[-600:]] if run.returncode else [], f"after {moment_s:.1f} s it had ended"
    run.send_signal(signal.SIGKILL)
    run.communicate()
    node = dice.choice(STATES)
    has_cut = (folder / "report").is_dir() and cut_last_write(folder / "report", node)
    code, result, told = resumed(folder, port, str(folder / "report"))
    done = f"killed after {moment_s:.1f} s, cut: {node if has_cut else 'nothing'}, " \
           f"{result.get('duration_s')} s"
    return wrongs(folder / "report", code, result, told), done


def main() -> int:
    """Run many."""
    first, runs = int(sys.argv[1]), int(sys.argv[2])
    port = int(sys.argv[3]) if len(sys.argv) > 3 else 18450
    bad = 0
    for seed in range(first, first + runs):
        with tempfile.TemporaryDirectory() as folder:
            wrong, done = one(Path(folder), seed, port)
        bad += bool(wrong)
        print(seed, done, "ok" if not wrong else f"BAD {'; '.join(wrong)}", flush=True)
    print(f"{bad} of {runs} bad", flush=True)
    return bad > 0


if __name__ == "__main__":
    sys.exit(main())
