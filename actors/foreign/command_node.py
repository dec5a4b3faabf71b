"""A node that is a command: the actor that stands for it, and starts and ends it.

For the rest of the system this actor is the node: it has the heartbeat, the liveliness token, the
incarnation, and publishes what the command says on its socket, so that faults can be injected into
it and recorders and other nodes find it. The command lives below a keeper
(`rampart.actors.foreign.keeper`). When the command ends, this actor fails; when the command is
silent for too long, the heartbeat of this actor stops; when this actor ends, however it does, so
does the command with all that it has forked.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.foreign import strays
from rampart.actors.foreign.channel import Channel
from rampart.actors.foreign.child import Child, CommandError, environment
from rampart.actors.foreign.program import LOGS, find_program, folder_of, log_folder
from rampart.actors.foreign.pulse import NotifySocket, Pulse
from rampart.actors.runtime.actor import Actor, Context, Header
from rampart.actors.runtime.parameters import TopicsHeard, TopicsPublished
from rampart.manager.spec.nodes import ChildHeartbeat, ChildLimits

_EXTEND = "EXTEND_TIMEOUT_USEC="
_DIGITS, _MOST_S = 12, 3600.0
"""Of what it may ask for, and real seconds that it gets at most."""

_ANYTHING = Topic("", msgspec.Struct, Qos.STATE, 0.0, "", "What is not decoded.")


class CommandNode(Actor):
    """Runs a command as a node."""

    class Parameters(Actor.Parameters, frozen=True):
        """What the table of the node says of the command; see `rampart.manager.spec.nodes`."""

        command: tuple[str, ...]
        env: dict[str, str] = {}
        folder: str = ""
        limits: ChildLimits = ChildLimits()
        heartbeat: ChildHeartbeat | None = None
        publishes: TopicsPublished = ()
        hears: TopicsHeard = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._child = Child(self._over)
        self._channel: Channel | None = None
        self._notify: NotifySocket | None = None
        self._pulse: Pulse | None = None
        beat = self.parameters.heartbeat
        if beat is not None:
            system = context.run.system
            self._pulse = Pulse(beat.timeout_s, system.timing.startup_grace_s,
                                2 * context.heartbeat_period_s)
            if beat.topic:  # by a client of its own; by its socket see `_take`
                self.hear_topic(beat.topic, self._own_topic)
        for key in self.parameters.hears:
            self.hear_topic(key, partial(self._pass_on, key))

    @classmethod
    def own_keys(cls, parameters: Any) -> tuple[str, ...]:
        """Hear the heartbeat of a command with a Zenoh client of its own."""
        beat = parameters.heartbeat
        return (beat.key,) if beat is not None and beat.key else ()

    def on_start(self) -> None:
        """Start the command; what an earlier one has left is killed first.

        Raises:
            CommandError: it cannot be started.
        """
        parameters, plan = self.parameters, self.context.run.plan
        if not strays.kill_strays(plan.folder, self.name):
            raise CommandError("processes of its predecessor do not end")
        folder = folder_of(plan, parameters.folder)
        if not folder.is_dir():
            raise CommandError(f"folder {folder}: there is none")
        program = find_program(parameters.command[0], folder, parameters.env.get("PATH"))
        if program is None:
            raise CommandError(f"{parameters.command[0]}: no such program in {folder}")
        publishes = {key: self.chosen_topic(key) for key in parameters.publishes}
        channel = self._channel = Channel(publishes, self._take, self._refuse, self.clock.now)
        own = {strays.NODE: self.name, strays.FOLDER: plan.folder,
               "RAMPART_INCARNATION": str(self.context.incarnation),
               "RAMPART_ORIGIN_S": repr(self.clock.source_time(0.0)),
               "RAMPART_RATE": repr(self.clock.rate), "RAMPART_SEED": str(plan.seed),
               "RAMPART_SOCKET": str(channel.other.fileno()),
               **self._reached()}
        own |= self._watch()
        self._child.start(
            who=f"{self.name} #{self.context.incarnation}",
            command=[program, *parameters.command[1:]], folder=folder,
            environment=environment(parameters.env, own), limits=parameters.limits,
            log=self._log(), inherited=[channel.other.fileno()])
        channel.other.close()

    def is_well(self) -> bool:
        """Whether the command is heard as often as it has to be."""
        if self._pulse is None or self._pulse.is_well(self.clock.now()):
            return True
        how = "" if self._pulse.heard else (
            " after its start; a larger startup_grace_s in [timing] gives it more time")
        self.report_diagnostic(
            "command", f"not heard for {self._pulse.limit_s:g} s{how}", self.name)
        return False

    def on_stop(self) -> None:
        """End the command, and everything that it has forked."""
        self._child.end()
        if self._channel is not None:
            self._channel.close()
        if self._notify is not None:
            asyncio.get_running_loop().remove_reader(self._notify.socket)
            self._notify.close()
        strays.kill_strays(self.context.run.plan.folder, self.name)

    # -- what becomes of it -----------------------------------------------------------------------

    def _over(self, why: str) -> None:
        def fail() -> None:
            raise CommandError(f"{self.parameters.command[0]} {why}; `rampart node log {self.name}`"
                               " shows its output")

        self.call_later(0.0, fail)  # in its mailbox, where an error ends the actor

    def _reached(self) -> dict[str, str]:
        """Return the variables by which a Zenoh client of its own reaches the routers."""
        plan = self.context.run.plan
        where, shown = endpoints(plan.folder), plan.credentials(self.name)
        if shown is None:
            return {"RAMPART_ZENOH": ",".join(where)}
        return {"RAMPART_ZENOH": ",".join(map(shown.door, where)),
                "RAMPART_AUTHORITY": shown.authority, "RAMPART_KEY": shown.own}

    def _watch(self) -> dict[str, str]:
        """Listen for its heartbeat; return the variables that say where it is awaited."""
        beat, pulse = self.parameters.heartbeat, self._pulse
        if beat is None or pulse is None:
            return {}
        if beat.key:
            self._bus.subscribe(_ANYTHING, f"{ROOT}/{beat.key}", lambda _key, _load: pulse.beat())
        if not beat.notify:
            return {}
        self._notify = NotifySocket(self.name)
        asyncio.get_running_loop().add_reader(
            self._notify.socket, self._notified, self._notify, pulse)
        return {"NOTIFY_SOCKET": self._notify.name,
                "WATCHDOG_USEC": str(math.ceil(beat.timeout_s / self.clock.rate * 1e6))}

    def _notified(self, notify: NotifySocket, pulse: Pulse) -> None:
        for said in notify.take():
            if said in {"READY=1", "WATCHDOG=1"}:
                pulse.beat()
            elif said == "WATCHDOG=trigger":
                pulse.trigger()
            elif said == "STOPPING=1":
                pulse.stopping()
            elif said.startswith(_EXTEND) and said.removeprefix(_EXTEND).isdecimal():
                pulse.extend(min(float(said.removeprefix(_EXTEND)[:_DIGITS]) * 1e-6, _MOST_S)
                             * self.clock.rate)

    def _log(self) -> Path:
        """Return the file for its output; the folder of the run says to tools where that is."""
        plan = self.context.run.plan
        folder = log_folder(plan)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            self.report_diagnostic("command", f"its output is not kept: {error}", self.name)
        here = Path(plan.folder, LOGS)
        if plan.folder and here != folder:
            with contextlib.suppress(FileExistsError):
                here.symlink_to(folder)
        return folder / f"{self.name}.log"

    # -- messages -------------------------------------------------------------------------------

    def _take(self, key: str, topic: Topic[Any], body: msgspec.Struct, stamp: float | None) -> None:
        beat = self.parameters.heartbeat
        if self._pulse is not None and beat is not None and key == beat.topic:
            self._pulse.beat()
        self.publish(topic, body, stamp, name=topic.member(key) or None)

    def _refuse(self, key: str, why: str) -> None:
        self.report_diagnostic("command's socket", why, key or self.name)

    def _own_topic(self, _message: Any, header: Header) -> None:
        if self._pulse is not None and header.source == self.name:
            self._pulse.beat()

    def _pass_on(self, key: str, message: Any, header: Header) -> None:
        if self._channel is not None:
            self._channel.say(key, self.chosen_topic(key), message, header)
