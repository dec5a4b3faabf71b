"""A whole system in virtual time, as `rampart run --virtual` runs it, with faults and a verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rampart import systems
from rampart.actors.layout.layout import load_run
from rampart.actors.run.run_plan import RunPlan, load_system
from rampart.files import working_folder
from rampart.sim.faults.scenario import parse_fault
from rampart.sim.runs.trial import trial_class
from rampart.sim.runs.virtual_run import VirtualResult, VirtualRun


def virtual_run(system: str | Path, *faults: str, seconds: float | None = None,
                **plan: Any) -> VirtualResult:
    """Run a system to its end, and return what came of it.

    Args:
        system: path, or name of one that ships.
        faults: as on the command line, `FAULT[@WHEN][+DURATION]`.
        seconds: simulated, after which the run is over; those of the specification if None.
        plan: fields of the `RunPlan`, such as `seed`, `ftm` and `options`.

    Returns:
        Among others `judgement`, the judge's verdict; `record`, with `decisions` and what became
        of `faults`; `trace`, a hash over all messages; `speed`, simulated seconds per second; and
        `failures`, the actors that ended by an error.

    Raises:
        ValueError: the system or a fault is unsound; one line says where.
    """
    file = systems.find(str(system))
    working_folder.admit(file.parent)
    chosen = RunPlan(system_file=str(file), **plan)
    spec = load_system(chosen)
    trial = trial_class(spec)(load_run(chosen, spec), seconds)
    if not trial.patient and trial.limit_s is None:
        raise ValueError(f"{system}: has no [end]; say after how many seconds the run is over")
    return VirtualRun(trial, scenario=[parse_fault(text) for text in faults]).run()
