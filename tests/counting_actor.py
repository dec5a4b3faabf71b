"""A node that counts, and keeps how far it has come."""

from __future__ import annotations

import msgspec

from rampart import Actor, Message, Qos, StateFormat, Topic, every


class Counted(Message, frozen=True):
    """How far it has come."""

    number: int


class State(msgspec.Struct, frozen=True):
    """The same, as it is kept."""

    number: int


COUNTED = Topic("counting/counted", Counted, Qos.SENSOR, 20, "", "How far it has come.")
FORM = StateFormat(State)


class Counting(Actor):
    """Counts on from where it was."""

    outputs = (COUNTED,)

    def on_start(self) -> None:
        state = self.kept(FORM)
        self._number = state.number if state else 0

    @every(0.05)
    def count(self) -> None:
        self._number += 1
        self.keep(FORM, State(self._number))
        self.publish(COUNTED, Counted(self._number))
