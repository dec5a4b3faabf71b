"""Signals to the processes of a real run, as `kill-node` sends them: for fault injection."""

from __future__ import annotations

from rampart.actors.supervision.kill_node import SignalError, signal_node


class ProcessSignals:
    """Signals to the newest process of a node. Each method tells whether one was sent.

    Args:
        port: Base port of the run.
    """

    def __init__(self, port: int) -> None:
        self._port = port

    def kill(self, node: str) -> bool:
        """SIGKILL."""
        return self._send(node, "KILL")

    def stop(self, node: str) -> bool:
        """SIGSTOP."""
        return self._send(node, "STOP")

    def resume(self, node: str) -> bool:
        """SIGCONT."""
        return self._send(node, "CONT")

    def wedge(self, node: str) -> bool:
        """Have its event loop turn no more; see `node_process`."""
        return self._send(node, "WEDGE")

    def slow_down(self, node: str, pace_s: float) -> bool:  # noqa: ARG002
        """Not in a real run: how slow a process is, is up to the machine."""
        return False

    def _send(self, node: str, name: str) -> bool:
        try:
            signal_node(node, name, self._port)
        except SignalError:
            return False
        return True
