"""Whole missions in virtual time with checkpoints, and what every one of them has to show."""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from rampart.actors.bus import messages as bm
from rampart.actors.osmosis import messages as m
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import load_run
from rampart.sim.faults.scenario import parse_fault
from rampart.sim.osmosis.trial.mission_trial import MissionTrial
from rampart.sim.runs.virtual_run import VirtualResult, VirtualRun
from rampart.sim.virtual.virtual_processes import VirtualMachine
from tests import ROOT

CONTROL = ("mission_manager", "graph_planner", "osmosis_control")
TRUE_VERDICTS = {"A03": "out", "A06": "dim", "A10": "out", "B02": "dim", "B07": "out", "B09": "dim"}
"""From the factors in the airport's `[world]`; all others are sound."""


def with_checkpoints(directory: Path) -> Path:
    """Write the paper's system with checkpoints."""
    text = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
    assert text.count("checkpoints = false") == 1
    file = directory / "osmosis-with-checkpoints.toml"
    file.write_text(text.replace("checkpoints = false", "checkpoints = true"), encoding="utf-8")
    return file


@dataclass
class Watched:
    """A run, and what was said in it about lights and steps."""

    result: VirtualResult
    status: m.MissionStatus
    measured: list[m.LightMeasurement] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    diagnostics: list[bm.Diagnostic] = field(default_factory=list)
    shelves: dict[str, list[Record]] = field(default_factory=dict)


class _Mission(MissionTrial):
    def watch(self) -> None:
        self.measured: list[m.LightMeasurement] = []
        self.statuses: list[m.MissionStatus] = []
        self.diagnostics: list[bm.Diagnostic] = []

    def sinks(self, clock):
        def take(_topic, message, _header):
            for kind, where in ((m.LightMeasurement, self.measured),
                                (m.MissionStatus, self.statuses),
                                (bm.Diagnostic, self.diagnostics)):
                if isinstance(message, kind):
                    where.append(message)

        return [*super().sinks(clock), take]


@contextmanager
def spying_on_machines() -> Iterator[list[VirtualMachine]]:
    """Collect the virtual machines that are made meanwhile."""
    made: list[VirtualMachine] = []
    original = VirtualMachine.__init__

    def spy(self, *arguments, **options):
        original(self, *arguments, **options)
        made.append(self)

    VirtualMachine.__init__ = spy
    try:
        yield made
    finally:
        VirtualMachine.__init__ = original


def fly(mission: str, faults: Sequence[str], *, seed: int = 1, system: Path | None = None
        ) -> Watched:
    """Run a mission with faults; the paper's system with checkpoints if none is named."""
    with TemporaryDirectory() as directory, spying_on_machines() as machines:
        file = system or with_checkpoints(Path(directory))
        plan = RunPlan("checkpoints", 1024, seed=seed, system_file=str(file),
                       options={"mission": mission})
        spec = load_system(plan)
        loaded = load_run(plan, spec)
        run = _Mission(loaded, 60.0)
        run.watch()
        result = VirtualRun(run, scenario=tuple(map(parse_fault, faults))).run()
    of_mission = [s for s in run.statuses if s.mission_id]
    return Watched(result, of_mission[-1], run.measured, [s.step for s in of_mission],
                   run.diagnostics, machines[0].shelves)


def lights_of(mission: str) -> dict[str, str]:
    """Return the lights that a shipped mission passes, with their true verdicts."""
    rows = ["A"] * (mission != "B") + ["B"] * (mission != "A")
    return {f"{row}{n:02}": TRUE_VERDICTS.get(f"{row}{n:02}", "ok")
            for row in rows for n in range(1, 12)}


def write_short_mission(directory: Path) -> Path:
    """Write a mission of a minute: to the row, over three lights, and on."""
    file = directory / "SHORT.miss"
    file.write_text("x=-22,y=-18.5,taxi=1\nx=-8.5,y=-18.5,taxi=0\nx=-4,y=-18.5,taxi=1\n")
    return file


def write_near_mission(directory: Path) -> Path:
    """Write a mission of half a minute: three goals near the start, no lights."""
    file = directory / "NEAR.miss"
    file.write_text("x=-28.5,y=4,taxi=1\nx=-29.5,y=-3,taxi=1\nx=-28.8,y=-11.5,taxi=1\n")
    return file


SHORT_LIGHTS = {"A01": "ok", "A02": "ok", "A03": "out"}


def assert_nothing_lost_or_doubled(run: Watched, expected: dict[str, str]) -> None:
    """Mission succeeded safely, no step twice or left out, each light measured once and rightly."""
    record = run.result.record
    assert (record.mission, record.safety, record.reasons) == ("success", "safe", ())
    assert run.result.failures == ()
    assert run.steps == sorted(run.steps), "the mission went back a step"
    assert len(run.status.step_times_s) == len(run.status.goals)
    names = [light.light for light in run.status.lights]
    assert sorted(names) == sorted(expected), "a light is lost or doubled"
    assert {light.light: light.verdict for light in run.status.lights} == expected
    # A measurement may be sent again; another measurement of the same light would be another value.
    assert len({(light.light, light.intensity_cd) for light in run.measured}) == len(expected)


def random_faults(seed: int, mission: str, count: int) -> list[str]:
    """Return kills, stops and wedges of control nodes at random moments, a few seconds apart."""
    dice = random.Random(f"{mission} {seed}")
    end_s = 165 if mission == "A" else 115
    moments = sorted(dice.uniform(0.5, end_s) for _ in range(count))
    return [f"{dice.choice(('kill', 'kill', 'stop', 'wedge'))}:{dice.choice(CONTROL)}@{t:.3f}"
            for t in moments]


def main() -> int:
    """Run many: `python -m tests.whole.checkpoint_runs FIRST_SEED RUNS FAULTS_PER_RUN`."""
    first, runs, count = map(int, sys.argv[1:4])
    bad = 0
    for seed in range(first, first + runs):
        mission = "AB"[seed % 2]
        faults = random_faults(seed, mission, count)
        run = fly(mission, faults, seed=seed)
        try:
            assert_nothing_lost_or_doubled(run, lights_of(mission))
            verdict = "ok"
        except AssertionError as error:
            bad += 1
            verdict = "BAD " + str(error).splitlines()[0]
        print(seed, mission, verdict, round(run.result.record.duration_s, 1), *faults, flush=True)
    print(f"{bad} of {runs} bad")
    return bad > 0


if __name__ == "__main__":
    sys.exit(main())
