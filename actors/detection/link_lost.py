"""`LinkLost`: another host of the system cannot be reached; the mechanism decides what follows."""

from __future__ import annotations

from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.tables import NonNegative, OptionalName


class LinkLost(DetectionModule):
    """Active when the first host's supervisor has counted a host as lost for long enough."""

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Host and times.

        Attributes:
            host: its name; "" for any.
            for_s: how long it has to be lost besides `[link] lost_after_s`, s.
            clear_s: how long it then has to be back, s.
        """

        host: OptionalName = ""
        for_s: NonNegative = 0.0
        clear_s: NonNegative = 0.2

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        said = self.parameters
        self.monitor = self.judged_by(Sustained(
            said.for_s, said.clear_s, self.known_after_s(said.for_s + said.clear_s)))

    @on(topics.NODES)
    def nodes(self, table: fm.NodeTable, _header: Header) -> None:
        """Note which hosts are lost."""
        lost = sorted({row.host for row in table.nodes if row.state is fm.NodeState.UNREACHABLE
                       and self.parameters.host in {"", row.host}})
        self.monitor.note(f"no link to {', '.join(lost)}" if lost else "", self.clock.now())
        self.follow()
