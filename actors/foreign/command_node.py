"""A node that is a command: an actor that represents the node, and starts and ends its program.

For the rest of the system this actor is the node. It sends the heartbeat, and publishes what the
program sends on its socket, so faults, recorders and other nodes treat it like any node. If the
program ends, or hangs and is killed, the incarnation has failed. The actor reports that to the
supervisor and stays. When the supervisor decides so, it starts the program again, as the next
incarnation. When this actor ends in any way, the program ends with everything that it has forked.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.foreign.channel import Channel
from rampart.actors.foreign.output_log import OutputLog
from rampart.actors.foreign.program import (
    find_program,
    folder_of,
    inherited_environment,
    log_folder,
    make_log_folder,
)
from rampart.actors.foreign.program_process import ProgramProcess
from rampart.actors.foreign.pulse import NotifySocket, Pulse, extension_s
from rampart.actors.ftm.messages import ProcessEvent, ProgramEnd
from rampart.actors.ftm.topics import PROCESS_EVENT, PROGRAM_END
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.parameters import TopicsHeard, TopicsPublished
from rampart.manager.spec.nodes import ChildHeartbeat, ChildLimits

_EXTEND, _STATUS = "EXTEND_TIMEOUT_USEC=", "STATUS="


class CommandNode(Actor):
    """Runs a command as a node."""

    class Parameters(Actor.Parameters, frozen=True):
        """The command, by the table of its node; see `rampart.manager.spec.nodes`."""

        command: tuple[str, ...]
        env: dict[str, str] = {}
        folder: str = ""
        limits: ChildLimits = ChildLimits()
        heartbeat: ChildHeartbeat | None = None
        publishes: TopicsPublished = ()
        hears: TopicsHeard = ()
        may_end: bool = False

    parameters: Parameters
    outputs = (PROGRAM_END,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._timing = context.run.system.timing
        self._heartbeat = self.parameters.heartbeat or ChildHeartbeat(
            self._timing.heartbeat_timeout_s)
        self._log = OutputLog(log_folder(context.run.plan) / f"{self.name}.log")
        self._program: ProgramProcess | None = None
        self._channel: Channel | None = None
        self._notify: NotifySocket | None = None
        self._pulse = Pulse(
            self._heartbeat.timeout_s, self._timing.startup_grace_s, 2 * context.heartbeat_period_s,
            [node for node in context.publishers(self._heartbeat.key) if node != self.name])
        self._failure = ""  # of this incarnation
        self._is_done = False
        if self._heartbeat.topic:  # from its own client; for its socket see `_take`
            self.hear_topic(self._heartbeat.topic, self._own_topic)
        for key in self.parameters.hears:
            self.hear_topic(key, partial(self._pass_on, key))

    @classmethod
    def own_keys(cls, parameters: Any) -> tuple[str, ...]:
        """Subscribe to the heartbeat of a command that has its own Zenoh client."""
        beat = parameters.heartbeat
        return (beat.key,) if beat is not None and beat.key else ()

    def on_start(self) -> None:
        """Start the program."""
        if self._heartbeat.key:
            self._bus.subscribe(
                f"{ROOT}/{self._heartbeat.key}", lambda _key, _load: self._alive())
        if why := make_log_folder(self.context.run.plan):
            self.report_diagnostic("command", why, self.name)
        self._start()

    def is_well(self) -> bool:
        """Whether the program lives and shows that it works; kills a program that hangs."""
        if self._is_done:
            return True
        if self._failure or self._program is None:
            self._report_failure()
            return False
        if self.parameters.heartbeat is None:
            self._alive()
        if self._pulse.is_well(self.clock.now()):
            return True
        limit = f"for {self._pulse.limit_s:g} s"
        if self._program.is_stopped:
            self._failure = f"was stopped {limit}"
        elif self._pulse.has_beaten:
            self._failure = f"hung: no heartbeat {limit}"
        elif self._pulse.carriers:
            self._failure = (f"hung: no heartbeat {limit} after its start or that of "
                             f"{' and '.join(self._pulse.carriers)}, which publishes "
                             f"{self._heartbeat.key}")
        else:
            self._failure = (f"hung: no heartbeat {limit} after its start; a larger "
                             "startup_grace_s in [timing] gives it more time")
        self._program.kill()
        return False

    def on_stop(self) -> None:
        """End the program and everything that it has forked."""
        if self._program is not None:
            self._program.end()
        self._close()
        self._log.close()

    @on(PROCESS_EVENT)
    def process_event(self, message: ProcessEvent, _header: Header) -> None:
        """Start the program again when the supervisor decides so."""
        self._pulse.note_process(message.node, message.event)
        if (message.node, message.event, message.pid) == (
                self.name, "respawned", self.context.pid
                ) and message.incarnation > self._incarnation and self._program is None:
            self.renew(message.incarnation)
            self._start()

    # -- the program ------------------------------------------------------------------------------

    def _start(self) -> None:
        self._failure = ""
        self._pulse.restart()
        parameters, plan = self.parameters, self.context.run.plan
        name, folder = parameters.command[0], folder_of(plan, parameters.folder)
        program = find_program(name, folder, parameters.env.get("PATH"))
        if program is None:
            self._failed(f"no such program in {folder}")
            return
        channel = self._channel = Channel(
            {key: self.chosen_topic(key) for key in parameters.publishes}, self._take,
            self._refuse, self.clock.now)
        who = f"{self.name} #{self._incarnation}"
        try:
            self._program = ProgramProcess(
                program, parameters.command[1:], folder=folder,
                environment=self._environment(channel.other.fileno()), limits=parameters.limits,
                log=self._log, inherited=[channel.other.fileno()], ended=self._ended)
        except (OSError, ValueError) as error:
            self._failed(f"cannot be started: {getattr(error, 'strerror', None) or error}")
        else:
            channel.other.close()
            self._log.note(f"{who} is process {self._program.pid}")
            if self._notify is not None:  # only now: a sender has to be a descendant
                asyncio.get_running_loop().add_reader(self._notify.socket, self._notified)

    def _environment(self, channel: int) -> Mapping[str, str]:
        """Return the variables of this process, of the node, and of the run."""
        plan = self.context.run.plan
        own = {"RAMPART_NODE": self.name, "RAMPART_INCARNATION": str(self._incarnation),
               "RAMPART_ORIGIN_S": repr(self.clock.source_time(0.0)),
               "RAMPART_RATE": repr(self.clock.rate), "RAMPART_SEED": str(plan.seed),
               "RAMPART_SOCKET": str(channel)}
        where, shown = endpoints(plan.folder), plan.credentials(self.name)
        if shown is None:
            own["RAMPART_ZENOH"] = ",".join(where)
        else:
            own |= {"RAMPART_ZENOH": ",".join(map(shown.door, where)),
                    "RAMPART_AUTHORITY": shown.authority, "RAMPART_KEY": shown.own}
        if self._heartbeat.notify:
            self._notify = NotifySocket(self.name, self._refuse)
            own |= {"NOTIFY_SOCKET": self._notify.name, "WATCHDOG_USEC": str(
                math.ceil(self._heartbeat.timeout_s / self.clock.rate * 1e6))}
        return {**inherited_environment(), **self.parameters.env, **own}

    def _ended(self, how: str) -> None:
        self._log.note(f"{self.name} #{self._incarnation} {how}")
        program = self._program
        if self.parameters.may_end and program and program.exit_code == 0 and not self._failure:
            self._is_done, self._program = True, None
            self._close()
        else:
            self._failed(self._failure or how)

    def _failed(self, why: str) -> None:
        """Note why this incarnation has failed, and report that until the next one starts."""
        self._close()
        self._program = None
        self._failure = clip(f"{self.parameters.command[0]} {why}; `rampart node log {self.name}`"
                             " shows its output")
        self._report_failure()

    def _report_failure(self) -> None:
        if self._program is None:
            self.publish(PROGRAM_END, ProgramEnd(self.context.pid, self._failure))

    def _close(self) -> None:
        if self._channel is not None:
            self._channel.close()
        if self._notify is not None:
            asyncio.get_running_loop().remove_reader(self._notify.socket)
            self._notify.close()
        self._channel = self._notify = None

    # -- its heartbeat --------------------------------------------------------------------------

    def _alive(self) -> None:
        """Note a heartbeat; while the program is stopped, only its children can send one."""
        if self._program is not None and not self._program.is_stopped:
            self._pulse.beat()

    def _own_topic(self, _message: Any, header: Header) -> None:
        if header.source == self.name:
            self._alive()

    def _notified(self) -> None:
        for assignment in self._notify.take() if self._notify is not None else ():
            if assignment in {"READY=1", "WATCHDOG=1"}:
                self._alive()
            elif assignment == "WATCHDOG=trigger":
                self._pulse.trigger()
            elif assignment == "STOPPING=1":
                self._pulse.stopping()
            elif assignment.startswith(_STATUS):
                self._log.note(f"{self.name} #{self._incarnation} {assignment}")
            elif assignment.startswith(_EXTEND):
                seconds = extension_s(assignment.removeprefix(_EXTEND))
                if seconds is not None and self._program and not self._program.is_stopped:
                    self._pulse.extend(seconds * self.clock.rate)

    # -- messages -------------------------------------------------------------------------------

    def _take(self, key: str, topic: Topic[Any], body: msgspec.Struct, stamp: float | None) -> None:
        if key == self._heartbeat.topic:
            self._alive()
        self.publish(topic, body, stamp, name=topic.member(key) or None)

    def _refuse(self, key: str, why: str) -> None:
        self.report_diagnostic("command's socket", why, key or self.name)

    def _pass_on(self, key: str, message: Any, header: Header) -> None:
        if self._channel is not None:
            self._channel.send(key, self.chosen_topic(key), message, header)
