"""Where a node keeps what it must not forget. The interface, and a store that forgets.

The paper's controller has no checkpoints ("it hasn't been implemented yet", section V-B), and
`NoCheckpoints` is that controller. A durable store fulfils the same protocol.
"""

from __future__ import annotations

from typing import Protocol


class CheckpointStore(Protocol):
    """Keeps one opaque, versioned state per node."""

    def save(self, node: str, version: int, state: bytes) -> None:
        """Keep a state; after the return it survives the node's death.

        Raises:
            OSError: it could not be made durable; the previous state is still there.
        """

    def load(self, node: str) -> tuple[int, bytes] | None:
        """Return version and state saved last, or None."""


class NoCheckpoints:
    """Keeps nothing: a respawned node starts afresh, as in the paper."""

    def save(self, node: str, version: int, state: bytes) -> None:
        """Forget the state."""

    def load(self, node: str) -> tuple[int, bytes] | None:  # noqa: ARG002
        """Return None."""
        return None
