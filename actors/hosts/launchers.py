"""The launchers of a run on several hosts: the first waits for the others, which ask it."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Callable

import msgspec

from rampart.actors.bus import run_folder
from rampart.actors.hosts.clock_sync import ClockSync
from rampart.actors.hosts.meeting import (
    DOOR,
    PERIOD_S,
    Attendance,
    Meeting,
    MeetingError,
    RunOverError,
    Told,
    contents_of,
    joined,
)
from rampart.actors.runtime.clock import keep_origin, origin_file
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, load_system, on_host
from rampart.actors.supervision.launcher import Launcher, LaunchError
from rampart.actors.system.hosts import Hosts
from rampart.actors.system.members import load_application

_RETRY_S = 0.2


class FirstLauncher(Launcher):
    """The first host's: as any launcher, but it starts when all hosts are ready.

    Attributes:
        say: is told for whom it waits.
        is_unwanted: whether the user has had enough of that.
    """

    def __init__(self, run: RunContext, title: str, link: socket.socket | None = None) -> None:
        super().__init__(run.plan, title, link)
        self.say: Callable[[str], None] = lambda _line: None
        self.is_unwanted: Callable[[], bool] = lambda: False
        self._run = run
        self._meeting: Meeting | None = None

    async def start(self) -> None:
        """Wait for the others, and start; raises LaunchError as any launcher."""
        hosts = Hosts(self._run.system)
        try:
            contents = contents_of(self.plan, self._run.application)
            self._meeting = Meeting(
                self.plan, tuple(host for host in hosts.supervisors if host), contents,
                lambda: run_folder.issued(self.plan.folder))
            await self._meeting.open(
                *hosts.meeting_place(), self.plan.credentials(DOOR))
        except (MeetingError, OSError) as error:
            raise LaunchError(str(error)) from None
        ready = asyncio.create_task(self._meeting.all_ready(self.say))
        while not ready.done():
            await asyncio.wait({ready}, timeout=_RETRY_S)
            if self.is_unwanted():
                ready.cancel()
                raise LaunchError("interrupted while it waited for the other hosts")
        await super().start()
        self._meeting.begin(self.plan.origin_s)

    async def end(self) -> None:
        """End this host's processes, and have the others end theirs."""
        if self._meeting is not None:
            await self._meeting.close()
        await super().end()


class OtherLauncher(Launcher):
    """Another host's, from the first question to the end of the run.

    Use: `connect`, `join`, `start`, `stay`, `end`.

    Args:
        own: what of the plan is this host's own.
        say: is told what happens, in a line.
        link: connection to this host's root.
    """

    def __init__(self, own: RunPlan, say: Callable[[str], None], link: socket.socket) -> None:
        self._spec = load_system(own)
        super().__init__(own, self._spec.title, link)
        hosts = Hosts(self._spec, own.host)
        self._own = own
        self._say = say
        self._where = hosts.meeting_place()
        self._clock_s = hosts.link.clock_s
        self._attendance = Attendance(
            own.host, self._where, contents_of(own),
            own.credentials(on_host(OBSERVER, own.host)))
        self._clocks = ClockSync(self._clock_s)
        self._run_id = ""
        self._begins_s = 0.0
        self._incarnations: dict[str, int] = {}
        self._said = self._unreachable = ""
        self._is_trusted = True

    async def join(self) -> None:
        """Wait for the first host, and take the plan of the run from it.

        Raises:
            MeetingError: this host may not take part.
        """
        while (told := await self._asked()) is None:
            pass
        plan = joined(told.plan, self._own)
        self._attendance.ready(contents_of(plan, load_application(plan, self._spec)))
        self._run_id, self._incarnations = plan.run_id, told.incarnations
        self.plan = msgspec.structs.replace(
            plan, incarnations=(told.starts - 1) * run_folder.EPOCH)

    async def load(self) -> None:
        """Have the root load the run, as any launcher."""
        await super().load()
        for name, incarnation in self._incarnations.items():
            run_folder.issue(self.plan.folder, [name], incarnation)

    async def start(self) -> None:
        """Load the run, and start this host's processes when the first host says so.

        Raises:
            LaunchError: They cannot be started.
            MeetingError: this host may not take part, or the run is over already, or another.
        """
        await self.load()
        while (told := await self._asked()) is None or told.origin_s is None:
            if told is not None:
                self._tell_user(f"waiting for {', '.join(told.waits_for) or 'the first host'}")
            await asyncio.sleep(PERIOD_S)
        self._begins_s = told.origin_s - self._clocks.offset_s
        await super().start()

    def origin_s(self) -> float:
        """Return when simulated time began, or will, as the first host has it."""
        self.follow(self._begins_s)
        return self._begins_s

    def follow(self, origin_s: float) -> None:
        """Have all processes of this host go by this origin."""
        keep_origin(origin_file(self.plan.folder), origin_s)
        self.plan = msgspec.structs.replace(self.plan, origin_s=origin_s)

    async def stay(self) -> str:
        """Follow the first host's clock until the run is over; return why it is.

        "" if this host has ended its part before.

        Raises:
            MeetingError: the first host runs something else by now.
        """
        while not self.failure:
            try:
                told = await self._asked()
            except RunOverError as over:
                return str(over)
            if told is not None and told.origin_s is not None:
                self.follow(told.origin_s - self._clocks.offset_s)
                self._judge_clock()
            await asyncio.sleep(PERIOD_S)
        return ""

    async def end(self) -> None:
        """Ask no more, and end this host's processes."""
        await self._attendance.close()
        await super().end()

    async def _asked(self) -> Told | None:
        """Ask once, and note what the answer shows of the clocks; None if there is no answer now.

        Raises:
            MeetingError: this host may not take part, or the first one has begun another run.
        """
        try:
            told, asked_s, heard_s = await self._attendance.ask()
        except OSError as error:
            why = error.strerror or str(error) or "no answer"
            self._unreachable = (f"the first host cannot be reached at {self._where[0]} port "
                                 f"{self._where[1]} ({why}); trying on")
            self._tell_user(self._unreachable)
            await asyncio.sleep(_RETRY_S)
            return None
        if self._said and self._said == self._unreachable:
            self._tell_user("the first host answers")
        if told.plan.run_id != (self._run_id or told.plan.run_id):
            raise MeetingError(f"the first host has begun another run ({told.plan.run_id}); "
                               "start this host again")
        self._clocks.exchanged(asked_s, told.now_s, heard_s)
        return told

    def _judge_clock(self) -> None:
        bound_s = self._clocks.bound_at(time.monotonic())
        is_trusted = bound_s <= self._clock_s
        if is_trusted != self._is_trusted:
            self._is_trusted = is_trusted
            self._tell_user(f"this host's clock is known within {bound_s * 1e3:.0f} ms of the "
                            f"first host's; [link] clock_s = {self._clock_s:g} "
                            + ("holds again" if is_trusted else "does not hold"))

    def _tell_user(self, line: str) -> None:
        if line != self._said:
            self._said = line
            self._say(line)
