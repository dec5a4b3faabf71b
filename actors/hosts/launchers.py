"""Launchers of a run on several hosts: the first host's waits for the others, which ask it."""

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
    Answer,
    Attendance,
    Meeting,
    MeetingError,
    RunOverError,
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
    """The first host's launcher, which starts when all hosts are ready.

    Args:
        run: The run.
        title: Of the run, for people.
        link: Connection to the root.
        is_unwanted: Whether the user has interrupted the run.
        say: Takes a line with the hosts that it waits for.
    """

    def __init__(self, run: RunContext, title: str, link: socket.socket,
                 is_unwanted: Callable[[], bool], say: Callable[[str], None]) -> None:
        super().__init__(run.plan, title, link)
        self._is_unwanted, self._say = is_unwanted, say
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
            await self._meeting.open(*hosts.meeting_place(), self.plan.credentials(DOOR))
        except (MeetingError, OSError) as error:
            raise LaunchError(str(error)) from None
        if not await self._meeting.all_ready(self._say, self._is_unwanted):
            raise LaunchError("interrupted while it waited for the other hosts")
        await super().start()
        self._meeting.begin(self.plan.origin_s)

    async def end(self) -> None:
        """End this host's processes, and have the others end theirs."""
        if self._meeting is not None:
            await self._meeting.close()
        await super().end()


class OtherLauncher(Launcher):
    """Another host's launcher, from the first question to the end of the run.

    Use: `connect`, `join`, `start`, `stay`, `end`.

    Args:
        own: Plan with this host's own fields.
        say: Takes a line for the user.
        link: Connection to this host's root.
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
        self._reported = ""
        self._is_connected = self._is_clock_known = True

    async def join(self) -> None:
        """Wait for the first host, and take the plan of the run from it.

        Raises:
            MeetingError: This host may not take part.
        """
        while (answer := await self._ask_first()) is None:
            pass
        plan = joined(answer.plan, self._own)
        self._attendance.ready(contents_of(plan, load_application(plan, self._spec)))
        self._run_id, self._incarnations = plan.run_id, answer.incarnations
        self.plan = msgspec.structs.replace(
            plan, incarnations=(answer.starts - 1) * run_folder.EPOCH)

    async def load(self) -> None:
        """Have the root load the run, as any launcher."""
        await super().load()
        for name, incarnation in self._incarnations.items():
            run_folder.issue(self.plan.folder, [name], incarnation)

    async def start(self) -> None:
        """Load the run, and start this host's processes when the first host starts its own.

        Raises:
            LaunchError: The processes cannot be started.
            MeetingError: This host may not take part, or the run is over, or another one runs.
        """
        await self.load()
        while (answer := await self._ask_first()) is None or answer.origin_s is None:
            if answer is not None:
                self._report(f"waiting for {', '.join(answer.waits_for) or 'the first host'}")
            await asyncio.sleep(PERIOD_S)
        self._begins_s = answer.origin_s - self._clocks.offset_s
        await super().start()

    def origin_s(self) -> float:
        """Return the reading of this host's clock at the first host's simulated time 0."""
        self.follow(self._begins_s)
        return self._begins_s

    def follow(self, origin_s: float) -> None:
        """Set the origin of time for all processes of this host."""
        keep_origin(origin_file(self.plan.folder), origin_s)
        self.plan = msgspec.structs.replace(self.plan, origin_s=origin_s)

    async def stay(self) -> str:
        """Follow the first host's clock until the run is over.

        Returns:
            Why the run is over; "" if only this host has ended its part.

        Raises:
            MeetingError: The first host has begun another run.
        """
        while not self.failure:
            try:
                answer = await self._ask_first()
            except RunOverError as over:
                return str(over)
            if answer is not None and answer.origin_s is not None:
                self.follow(answer.origin_s - self._clocks.offset_s)
                self._check_clock()
            await asyncio.sleep(PERIOD_S)
        return ""

    async def end(self) -> None:
        """Ask no more, and end this host's processes."""
        await self._attendance.close()
        await super().end()

    async def _ask_first(self) -> Answer | None:
        """Ask once, and measure the clocks; None without an answer.

        Raises:
            MeetingError: This host may not take part, or the first one has begun another run.
        """
        try:
            answer, sent_s, received_s = await self._attendance.ask()
        except OSError as error:
            self._is_connected = False
            why = error.strerror or str(error) or "no answer"
            self._report(f"the first host cannot be reached at {self._where[0]} port "
                         f"{self._where[1]} ({why}); trying again")
            await asyncio.sleep(_RETRY_S)
            return None
        if not self._is_connected:
            self._is_connected = True
            self._report("the first host answers")
        if answer.plan.run_id != (self._run_id or answer.plan.run_id):
            raise MeetingError(f"the first host has begun another run ({answer.plan.run_id}); "
                               "start this host again")
        self._clocks.add_exchange(sent_s, answer.now_s, received_s)
        return answer

    def _check_clock(self) -> None:
        bound_s = self._clocks.bound_at(time.monotonic())
        is_known = bound_s <= self._clock_s
        if is_known != self._is_clock_known:
            self._is_clock_known = is_known
            self._report(f"the offset to the first host's clock is known within "
                         f"{bound_s * 1e3:.0f} ms, {'as' if is_known else 'not as'} expected: "
                         f"[link] clock_s = {self._clock_s:g}")

    def _report(self, line: str) -> None:
        if line != self._reported:
            self._reported = line
            self._say(line)
