"""Whole flights in virtual time: the system as it is run, with faults, and its judge's verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from quadrotor import topics as t
from quadrotor.judge import FlightJudge

from rampart import Verdict
from rampart.actors.bus.envelope import decode
from rampart.actors.layout.layout import load_run
from rampart.actors.run.run_plan import RunPlan, load_system
from rampart.sim.faults.scenario import parse_fault
from rampart.sim.runs.trial import Trial
from rampart.sim.runs.virtual_run import VirtualRun

SYSTEM = Path(__file__).parents[1] / "quadrotor.toml"


class Flight(NamedTuple):
    verdict: Verdict
    why: str
    duration_s: float
    speed: float
    trace: str
    recoveries: tuple[str, ...]
    faults: tuple[Any, ...]
    failures: Any
    truths: list
    result: Any


class _Judged(Trial):
    judge: Any = None

    def over(self, now_s):
        return self.judge.over(now_s) or super().over(now_s)


def fly(*faults: str, seconds: float = 90.0, seed: int = 3, ftm: bool = True) -> Flight:
    plan = RunPlan(system_file=str(SYSTEM), seed=seed, ftm=ftm)
    spec = load_system(plan)
    run = load_run(plan, spec)
    judge = FlightJudge(FlightJudge.Parameters(waypoints=tuple(
        map(tuple, next(n for n in spec.nodes if n.name == "mission").parameters["waypoints"]))))
    trial = _Judged(run, seconds)
    trial.judge = judge
    truths = []

    def tap(now_s, key, payload):
        if key == t.TRUTH.at():
            header, message = decode(t.TRUTH, payload)
            header = header if hasattr(header, "stamp") else header
            judge.truth(message, _At(now_s))
            truths.append((now_s, message))

    run = VirtualRun(trial, scenario=[parse_fault(f) for f in faults], taps=[tap])
    result = run.run()
    return Flight(judge.verdict(), result.why, result.record.duration_s, result.speed, result.trace,
                  tuple(result.record.decisions), result.record.faults, result.failures, truths,
                  result)


class _At(NamedTuple):
    stamp: float
