"""Counts what a recording has missed: each node numbers what it sends, without gaps. Pure."""

from __future__ import annotations

from collections import Counter

from rampart.actors.bus.envelope import Header


class SequenceGaps:
    """Numbers heard, incarnation by incarnation.

    Args:
        from_start: whether every node is heard from its first message on; else only incarnations
            that begin later are.
    """

    def __init__(self, *, from_start: bool = False) -> None:
        self._from_start = from_start
        self._first: dict[str, int] = {}
        self._last: dict[tuple[str, int], int] = {}
        self._lost = Counter[str]()

    def hear(self, header: Header) -> None:
        """Note one message; copies have the same number."""
        one = (header.source, header.incarnation)
        last = self._last.get(one)
        if last is None:
            first = self._first.setdefault(header.source, header.incarnation)
            new = self._from_start or header.incarnation > first
            last = 0 if new else header.sequence - 1
        if header.sequence > last + 1:
            self._lost[header.source] += header.sequence - last - 1
        self._last[one] = max(last, header.sequence)

    def lost(self) -> dict[str, int]:
        """Return source → messages that were sent and not recorded."""
        return dict(self._lost)
