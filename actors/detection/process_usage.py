"""`ProcessUsage`: a node uses too much processor time or memory."""

from __future__ import annotations

from typing import Any

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.machine.process_usage import ProcessCount
from rampart.actors.runtime.actor import Context, Header, every, on
from rampart.actors.runtime.parameters import NodeNames
from rampart.manager.spec.tables import NonNegative, Positive

PERIOD_S = 0.5
_MB = 1e6


class ProcessUsage(DetectionModule):
    """Active when a watched node has used too much for long enough.

    Nodes that share a process share its usage. In virtual time the module is idle.
    """

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Nodes and limits.

        Attributes:
            watch: names of the nodes.
            processor_share: share of a core that a process may use.
            memory_mb: resident memory that it may use, MB (10^6 bytes).
            for_s: how long it has to use more, s.
            clear_s: how long it has to use less before the module is idle again, s.
        """

        watch: NodeNames
        processor_share: Positive | None = None
        memory_mb: Positive | None = None
        for_s: NonNegative = 2.0
        clear_s: NonNegative = 2.0

        def __post_init__(self) -> None:
            """Refuse parameters without a limit."""
            if self.processor_share is None and self.memory_mb is None:
                raise ValueError("memory_mb: missing; give it, processor_share or both")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        chosen = self.parameters
        self._looks: dict[str, tuple[tuple[int, int], float, ProcessCount]] = {}
        self._running: dict[str, tuple[int, int]] = {}
        self.monitor = self.judged_by(Sustained(
            chosen.for_s, chosen.clear_s, self.known_after_s(chosen.for_s + 2 * PERIOD_S)))

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Parameters) -> Members:  # noqa: ARG003
        """Subscribe to the heartbeats of the watched nodes, which carry their process ids."""
        return parameters.watch

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, message: Heartbeat, header: Header) -> None:
        """Note which process a node runs in."""
        self._running[header.source] = (
            self.context.local_pid(header.source, message.pid), header.incarnation)

    @every(PERIOD_S)
    def look(self) -> None:
        """Measure the processes."""
        wrong = {node: why for node, (pid, incarnation) in self._running.items()
                 if (why := self._problem(node, pid, incarnation))}
        self.monitor.accused = tuple(f"{node}#{self._running[node][1]}" for node in wrong)
        if self._running:
            self.monitor.note("; ".join(f"{node}: {why}" for node, why in wrong.items()),
                              self.clock.now())
        self.follow()

    def _problem(self, node: str, pid: int, incarnation: int) -> str:
        usage, chosen = self.context.usage(pid), self.parameters
        if usage is None:
            return ""
        now_s = self.clock.now() / self.clock.rate  # the processor's time is real
        look = (pid, incarnation), now_s, usage
        process, before_s, before = self._looks.get(node, look)
        self._looks[node] = look
        if chosen.memory_mb is not None and usage.memory_bytes > chosen.memory_mb * _MB:
            return f"{usage.memory_bytes / _MB:.0f} MB of memory, more than {chosen.memory_mb:g} MB"
        if chosen.processor_share is None or process != look[0] or now_s <= before_s:
            return ""
        share = (usage.cpu_s - before.cpu_s) / (now_s - before_s)
        if share > chosen.processor_share:
            return f"{share:.2f} of a core, more than {chosen.processor_share:g}"
        return ""
