"""A supervised process together with what the supervisor holds of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from rampart.actors.bus.run_folder import restarts_of
from rampart.actors.ftm.messages import NodeInfo
from rampart.actors.runtime.timer import Timer
from rampart.actors.supervision.processes import ProcessHandle
from rampart.actors.supervision.supervised_process import SupervisedProcess


@dataclass
class HeldProcess(SupervisedProcess):
    """A process, and what the supervisor has in hand of it.

    Attributes:
        handle: On the process that is there.
        next_step: Towards its fork, while that is under way; there is never more than one.
    """

    handle: ProcessHandle = field(default_factory=ProcessHandle)
    next_step: Timer | None = None

    def rows(self, late_s: Callable[[str], float], now_s: float) -> Iterator[NodeInfo]:
        """Return the rows of its nodes in the table of all; `late_s` says how late one was."""
        failing = self.lives.failing(now_s)
        for node in self.unit.nodes:
            yield NodeInfo(node.name, node.kind.value, self.pid, self.shown, self.incarnation,
                           restarts_of(self.incarnation), late_s(node.name),
                           failing=failing)

    def take(self, pid: int, incarnation: int) -> None:
        """Note that another process is the present one, and let go of the one before."""
        self.forget_step()
        self.let_go()
        super().take(pid, incarnation)

    def let_go(self) -> None:
        """Hold nothing."""
        self.handle.close()
        self.handle = ProcessHandle()

    def kill(self) -> None:
        """End it at once, and do not report that; not if only its program has to be replaced."""
        if not self.stays:
            self.handle.ignore()
            self.handle.kill()

    def forget_step(self) -> None:
        """Have the next step towards a fork not taken."""
        if self.next_step is not None:
            self.next_step.cancel()
