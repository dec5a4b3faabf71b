"""One run of a campaign: its job, its execution, its result.

A job is data. The same job gives the same result on any machine of the same architecture. So the
key of a job identifies its result, and running the job again repeats the run.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeVar

import msgspec

from rampart import systems
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan, load_system, tailor
from rampart.actors.system.members import application_class, load_application
from rampart.files import toml, working_folder
from rampart.files.reading import read_text
from rampart.manager.spec.adaptation import Action, Change, adapt
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.specification import check_document, read_document
from rampart.sim.campaign.defaults import PATIENCE_S
from rampart.sim.faults.faults import faults_of
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.scenario import FaultOutcome, PlannedFault
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.trial import trial_class
from rampart.sim.runs.virtual_run import VirtualResult, VirtualRun
from rampart.sim.virtual.network import find_network

T = TypeVar("T")


class Job(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One run.

    Attributes:
        row: Name of its row of the table.
        system: Shipped system by name, or path of a spec.
        retuned: Changes to recoveries, detections and mechanisms before the run: name → fields.
        strategy: Of the manager; empty for the spec's.
        options: Of the system's application; others are the spec's.
        ftm: False for the unprotected baseline.
        network: Name of the network between the nodes.
        faults: The planned faults.
        seed: Of all random numbers.
        patience_s: See `PATIENCE_S`.
        duration_s: Duration of a run without a mission; None for the spec's.
        content: Digest of files and code, see `rampart.sim.campaign.content`.
    """

    row: str
    system: str = systems.DEFAULT.stem
    retuned: dict[str, dict[str, Any]] = {}
    strategy: str = ""
    options: dict[str, Any] = {}
    ftm: bool = True
    network: str = "measured"
    faults: tuple[PlannedFault, ...] = ()
    seed: int = 1
    patience_s: float = PATIENCE_S
    duration_s: float | None = None
    content: str = ""

    @property
    def key(self) -> str:
        """Short name of the run; it does not depend on the row."""
        return hashlib.sha256(msgspec.msgpack.encode(
            msgspec.structs.replace(self, row=""), order="deterministic")).hexdigest()[:12]

    def text(self) -> str:
        """Return its faults for people."""
        return ", ".join(fault.text() for fault in self.faults) or "no fault"


class DecisionTaken(msgspec.Struct, frozen=True, array_like=True):
    """A decision of the manager."""

    t_s: float
    active: tuple[str, ...]
    recoveries: tuple[str, ...]


class RunResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a run. Times are simulated seconds.

    Attributes:
        success: Whether the judge found the task done.
        safe: Whether the judge, by ground truth, found the run safe all the time.
        reasons: Why not.
        duration_s: Length of the run.
        margins: See `Judgement`, as the next two.
        severity: How unsafe it was.
        unsafe_s: When it first became unsafe.
        narrowest_s: When the smallest margin was measured.
        injected_s: When the first effective fault was injected.
        detected_after_s: Time from then to the first detection.
        detected_by: Detection modules that have detected something since, the first one first.
        recovered_after_s: Time from then until no recovery was active.
        false_alarms: Detections before any fault.
        decisions: All decisions of the manager.
        outcomes: Effects of the faults.
        failures: Actors that ended by an error.
        trace: Hash over all messages.
        wall_s: Real duration without loading.
        judged: Whether there was a judge; without one success and safety are meaningless.
        restarts: Number of restarts of all nodes.
    """

    success: bool
    safe: bool
    reasons: tuple[str, ...]
    duration_s: float
    margins: dict[str, float | None]
    severity: float
    unsafe_s: float | None
    injected_s: float | None
    detected_after_s: float | None
    recovered_after_s: float | None
    false_alarms: int
    decisions: tuple[DecisionTaken, ...]
    outcomes: tuple[FaultOutcome, ...]
    failures: tuple[str, ...]
    trace: str
    wall_s: float
    judged: bool = True
    restarts: int = 0
    detected_by: tuple[str, ...] = ()
    narrowest_s: float | None = None

    @property
    def stopped_for_good(self) -> bool:
        """Whether the mission failed and the robot was safe."""
        return self.safe and not self.success

    @property
    def effective(self) -> bool:
        """Whether a fault changed anything; true of a run without faults."""
        return not self.outcomes or any(outcome.effective for outcome in self.outcomes)

    @property
    def counts(self) -> bool:
        """Whether the run counts: a fault had an effect, or the run was unsafe or failed.

        A run without an effect shows nothing. An unsafe or failed run is never left out, even if
        its fault reports no effect.
        """
        return self.effective or not (self.safe and self.success)

    @property
    def margin(self) -> float:
        """The smallest of the margins: the distance from an unsafe run."""
        return min((m for m in self.margins.values() if m is not None), default=math.inf)


def run_job(job: Job) -> RunResult:
    """Run a job in virtual time and return its result."""
    result = run_virtually(job)
    record, judged, injected_s = result.record, result.judgement, None
    effective = [o.injected_s for o in record.faults if o.effective and o.injected_s is not None]
    if effective:
        injected_s = min(effective)
    return RunResult(
        success=record.mission in {"success", None}, safe=record.safety in {"safe", None},
        judged=record.mission is not None, restarts=sum(record.restarts.values()),
        reasons=record.reasons,
        duration_s=round(record.duration_s, 2), margins=judged.margins, severity=judged.severity,
        unsafe_s=judged.unsafe_s, narrowest_s=judged.narrowest_s,
        injected_s=injected_s, **latencies(record, injected_s),
        decisions=tuple(DecisionTaken(round(d.t_s, 3), d.active, d.recoveries)
                        for d in record.decisions),
        outcomes=record.faults,
        failures=tuple(f"{name}: {error}" for name, error in result.failures),
        trace=result.trace, wall_s=round(result.wall_s, 2))


def run_virtually(job: Job) -> VirtualResult:
    """Run a job in virtual time and return everything known; raises as `virtual_run`."""
    return virtual_run(job).run()


def virtual_run(job: Job) -> VirtualRun:
    """Return a job's run in virtual time, not started yet.

    Raises:
        ValueError: The job is invalid: unknown system, mission or fault.
    """
    file, document = read_document_of(job.system)
    for name, values in job.retuned.items():
        document = adapt(document, Change(Action.RETUNE, name, values), file)[0]
    chosen = {"strategy": job.strategy} if job.strategy else {}
    spec = check_document({**document, **chosen}, file)
    plan = RunPlan(
        run_id=job.key, base_port=1024, seed=job.seed, system_file=file, ftm=job.ftm,
        options=job.options, virtual=True)
    nodes, spec = can_be_hit(spec), tailor(plan, spec)
    application = _application(msgspec.json.encode(plan.options), file)
    kind = trial_class(spec)
    if not kind.patient and (job.duration_s or spec.end.after_s) is None:
        raise ValueError(f"{file}: $.end.after_s: missing; a run in virtual time needs an end")
    trial = kind(RunContext(plan, spec, document, application),
                 job.patience_s if kind.patient else job.duration_s)
    return VirtualRun(trial, network=find_network(job.network), scenario=job.faults, nodes=nodes)


def latencies(record: RunRecord, injected_s: float | None) -> dict[str, Any]:
    """Return time to detect, detecting modules, time to recover and number of false alarms."""
    detections = [(bar.from_s, bar.name) for bar in record.intervals if bar.lane == "detection"]
    if injected_s is None:
        return {"detected_after_s": None, "recovered_after_s": None,
                "false_alarms": len(detections)}
    found = sorted(bar for bar in detections if bar[0] >= injected_s)
    after = [t for t, _ in found]
    calm = None
    if after:
        decided = [d for d in record.decisions if d.t_s >= after[0]]
        if decided and not decided[-1].recoveries:
            calm = decided[-1].t_s
    return {
        "detected_after_s": round(after[0] - injected_s, 4) if after else None,
        "detected_by": tuple(dict.fromkeys(name for _, name in found)),
        "recovered_after_s": round(calm - injected_s, 3) if calm is not None else None,
        "false_alarms": len(detections) - len(found)}


@lru_cache(maxsize=8)
def read_document_of(system: str) -> tuple[str, dict[str, Any]]:
    """Return path and document of a system spec."""
    file = systems.find(system)
    working_folder.admit(file.parent)
    return str(file), read_document(read_text(file, toml.MAX_SIZE), str(file))


def _of_system(made: Callable[[SystemSpec], T]) -> Callable[[str], T]:
    """Return a cached function of a system's name or file."""
    @lru_cache(maxsize=8)
    def of_system(system: str) -> T:
        file, document = read_document_of(system)
        return made(check_document(document, file))

    return of_system


# Each raises a ValueError if the system is unknown or unsound.
faults_of_system = _of_system(faults_of)
application_of_system = _of_system(application_class)
trial_of_system = _of_system(trial_class)


def application_of_job(job: Job) -> Application:
    """Return the application of a job's run; raises as `faults_of_system`."""
    return _application(msgspec.json.encode(job.options), read_document_of(job.system)[0])


@lru_cache(maxsize=8)
def _application(options: bytes, file: str) -> Application:
    """Load an application once: the map of an airport is large, and read-only."""
    plan = RunPlan(system_file=file, options=msgspec.json.decode(options))
    return load_application(plan, load_system(plan))
