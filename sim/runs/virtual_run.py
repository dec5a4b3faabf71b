"""A mission in virtual time: the real actors as tasks on one loop, faster than real time.

The same seed gives the same run, byte for byte. Sensors, network, processes and faults have
separate random generators, seeded from the plan, and time is the loop's. The proof is a hash over
all messages with their times of sending.
"""

from __future__ import annotations

import asyncio
import gc
import hashlib
import struct
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace

import msgspec

from rampart.actors.runtime.actor import Context
from rampart.actors.runtime.run_plan import OBSERVER
from rampart.actors.system.layout import Layout
from rampart.actors.web.access import PagePlan
from rampart.sim.faults.injector import INJECTOR, can_be_hit
from rampart.sim.faults.scenario import PlannedFault
from rampart.sim.runs.judge import Verdict
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.trial import Trial
from rampart.sim.virtual.network import NETWORKS, NetworkModel, SeededNetwork
from rampart.sim.virtual.virtual_bus import Hub, Tap, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualClock, VirtualLoop
from rampart.sim.virtual.virtual_processes import VirtualMachine

LEAD_S = 1.0
"""Virtual seconds before simulated time 0, in which the processes start."""

_LOOK_S = 0.05
_CHUNK = 3000
_HEAD = struct.Struct("<dI").pack


class VirtualResult(msgspec.Struct, frozen=True):
    """Result of a virtual run.

    Attributes:
        record: Record of the run.
        judgement: Verdict.
        why: Why it ended.
        trace: SHA-256 over all messages, in hexadecimal.
        messages: Number of messages.
        wall_s: Duration without loading.
        failures: Actors that ended by an error, with the error's text.
        tracebacks: Their tracebacks.
    """

    record: RunRecord
    judgement: Verdict
    why: str
    trace: str
    messages: int
    wall_s: float
    failures: tuple[tuple[str, str], ...]
    tracebacks: str

    @property
    def speed(self) -> float:
        """Simulated seconds per second."""
        return (self.record.duration_s + LEAD_S) / self.wall_s if self.wall_s > 0 else 0.0


class Trace:
    """A hash over all messages in the order of sending."""

    def __init__(self) -> None:
        self.messages = 0
        self._hash = hashlib.sha256()
        self._names: dict[tuple[str, str], bytes] = {}
        self._waiting: list[bytes] = []

    def __call__(self, now_s: float, source: str, key: str, payload: bytes) -> None:
        """Take one message."""
        self.messages += 1
        name = self._names.get((source, key))
        if name is None:
            name = self._names[source, key] = f"{source} {key} ".encode()
        self._waiting += (_HEAD(now_s, len(payload)), name, payload)
        if len(self._waiting) > _CHUNK:
            self._flush()

    def _flush(self) -> None:
        self._hash.update(b"".join(self._waiting))
        self._waiting.clear()

    def digest(self) -> str:
        """Return the hash so far."""
        self._flush()
        return self._hash.hexdigest()


def _tap(take: Callable[[float, str, bytes], None], zero_s: float) -> Tap:
    return lambda now_s, _source, key, payload: take(now_s - zero_s, key, payload)


class VirtualRun:
    """One trial in virtual time. Use: `run`, once.

    Args:
        trial: The trial; id, rate and ports of its plan are ignored.
        network: Network between the nodes; the measured one if None.
        scenario: Faults and their times.
        nodes: Nodes that faults may name, whether they run or not; those of the spec if None.
        taps: Called with each message: simulated time, key, payload.

    Raises:
        ValueError: An actor class cannot be loaded.

    Attributes:
        interrupted: Setting it, perhaps from a signal handler, ends the run for this reason.
    """

    def __init__(self, trial: Trial, *, network: NetworkModel | None = None,
                 scenario: Sequence[PlannedFault] = (), nodes: Sequence[str] | None = None,
                 taps: Sequence[Callable[[float, str, bytes], None]] = ()) -> None:
        # Nothing that differs from run to run may get into a message.
        self.plan = msgspec.structs.replace(
            trial.run.plan, run_id=f"virtual-{trial.run.plan.seed}", rate=1.0,
            page=PagePlan(), launcher_pid=1, virtual=True)
        self.trial = trial
        self.interrupted: str | None = None
        self._context = replace(trial.run, plan=self.plan)
        spec = self._context.system
        self._layout = Layout(self.plan, spec, self._context.application)
        self._network = network or NETWORKS["measured"]
        self._scenario = tuple(scenario)
        self._taps = tuple(taps)
        self._nodes = can_be_hit(spec) if nodes is None else tuple(nodes)

    def run(self) -> VirtualResult:
        """Run to the end on a new loop."""
        # Loaded objects stay, and nearly all objects of a run are freed without the collector.
        gc.collect()
        gc.freeze()
        threshold = gc.get_threshold()
        gc.set_threshold(50_000, 20, 100)
        try:
            with asyncio.Runner(loop_factory=VirtualLoop) as runner:
                return runner.run(self._run())
        finally:
            gc.set_threshold(*threshold)
            gc.unfreeze()

    async def _run(self) -> VirtualResult:
        begun_s = time.perf_counter()
        loop = asyncio.get_running_loop()
        if not isinstance(loop, VirtualLoop):
            raise TypeError(f"{loop!r}: a virtual run needs a virtual loop")
        clock = VirtualClock(loop, loop.time() + LEAD_S)
        hub = Hub(SeededNetwork(self._network, self.plan.seed, local=(OBSERVER, INJECTOR)).link)
        trace = Trace()
        hub.taps.append(trace)
        hub.taps += [_tap(take, loop.time() + LEAD_S) for take in self._taps]
        machine = VirtualMachine(self._layout, self._context, hub, clock, seed=self.plan.seed)
        machine.on_restart = lambda name: self.trial.brought_back(name, clock.now())

        def context(name: str) -> Context:
            return Context(name, 1, clock, VirtualBus(hub, name), pid=1,
                           members=frozenset(self._layout.members))

        actors = self.trial.outside(
            context, machine.supervisor_heard, self._scenario, machine.hit, self._nodes)
        watching = [asyncio.create_task(actor.run()) for actor in actors]
        machine.start()
        why = None
        while why is None and not any(task.done() for task in watching):
            await asyncio.sleep(_LOOK_S)
            why = self.interrupted or self.trial.ended(clock.now())
        now_s = clock.now()
        machine.shut_down()
        for actor in actors:
            actor.stop()
        await asyncio.gather(*watching)
        record = self.trial.conclude(now_s, why or "ended")
        return VirtualResult(
            record, self.trial.judgement(record), why or "ended", trace.digest(), trace.messages,
            time.perf_counter() - begun_s,
            tuple((name, f"{type(error).__name__}: {error}") for name, error in machine.failures),
            "".join(f"--- {name}\n{''.join(traceback.format_exception(error))}"
                    for name, error in machine.failures))
