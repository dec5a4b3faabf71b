"""Does things to the processes of a real run, as `kill-node` does: for fault injection."""

from __future__ import annotations

import os
import signal

from rampart.actors.supervision.process_title import find_processes


class ProcessHand:
    """Signals to the newest process of a node. Each method tells whether there was one.

    Args:
        port: Base port of the run.
    """

    def __init__(self, port: int) -> None:
        self._port = port

    def kill(self, node: str) -> bool:
        """SIGKILL."""
        return self._send(node, signal.SIGKILL)

    def stop(self, node: str) -> bool:
        """SIGSTOP."""
        return self._send(node, signal.SIGSTOP)

    def resume(self, node: str) -> bool:
        """SIGCONT."""
        return self._send(node, signal.SIGCONT)

    def wedge(self, node: str) -> bool:
        """Have its event loop turn no more; see `node_process`."""
        return self._send(node, signal.SIGUSR2)

    def slow_down(self, node: str, pace_s: float) -> bool:  # noqa: ARG002
        """Not in a real run: how slow a process is, is up to the machine."""
        return False

    def _send(self, node: str, number: signal.Signals) -> bool:
        found = [p for p in find_processes(self._port) if node in p.names]
        if not found:
            return False
        try:
            os.kill(max(found, key=lambda p: p.incarnation).pid, number)
        except ProcessLookupError:
            return False
        return True
