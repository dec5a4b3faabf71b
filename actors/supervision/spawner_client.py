"""The supervisor's and the launcher's side of the spawners: fork through whichever answers.

A spawner that is stopped, hung or starved must cost its caller no time and lead to no second
process of one incarnation. Both follow from how a request ends:

* The new process itself answers, and runs only if its answer was accepted. A caller that withdraws
  a request shuts its end of the connection first and looks for an answer then. The kernel decides
  which of the two came first: either the answer is there, and with it the process, or it is
  refused, and the process ends at once, however late a spawner comes to fork it.
* So a request may wait while its caller goes on: `fork` is called again, and finds the answer.

Nothing is killed here. Whether a spawner hangs or only waits for a processor is judged by the
launcher (`guard`), which can replace it. Answers are not believed blindly: both ends check the
other one's user, and the process is the one that sent the answer, as the kernel says, if /proc
shows it under the title that was asked for.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time

import msgspec

from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.bus.run_folder import change_system
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.machine.unix_peer import is_same_user, process_state, receive_signed
from rampart.actors.supervision import spawner as protocol
from rampart.actors.supervision.node_process import Waits
from rampart.actors.supervision.process_title import WAITING, find_process, kill
from rampart.actors.supervision.spawner import NAMES, Reply, Request

WAIT_S = 0.05
"""A fork takes a millisecond or two. So long its caller stands still for it, at most for each
spawner, and not for one that was slow before."""

PATIENCE_S = 0.25
"""So long a request stays with a spawner that does not answer, if there is another one to ask; each
time longer, for on a machine that is busy enough the new process cannot answer sooner either."""

START_PATIENCE_S = 10.0

_SILENT_S = 2.0
"""One that waits and does not answer for so long is replaced; if it only lacks a processor, that
costs no more than the fork."""

_GO_S = 0.005
"""One that waits to be promoted answers sooner, unless it is still being set up or hangs."""


class SpawnerUnavailableError(Exception):
    """No spawner can do it now."""


class SpawnerBusyError(SpawnerUnavailableError):
    """A spawner has been asked a moment ago and has not answered yet."""


class _Asked:
    """A connection to one spawner, and what was asked of it: the answer to the last counts."""

    def __init__(self, spawner: str, connection: socket.socket) -> None:
        self.spawner = spawner

        self._connection = connection
        self._unanswered = 0
        self._first = 0
        self.sent = False
        self.waits = self.rehearses = False
        self.patience_s = PATIENCE_S
        self._since_s = time.monotonic()
        self._reply: Reply | None = None

    @property
    def overdue(self) -> bool:
        """Whether another spawner is to be asked."""
        return time.monotonic() - self._since_s > self.patience_s

    def turns(self) -> bool:
        """Whether one that waits has answered what it was asked last; ask it again."""
        while self._reply is None and self._is_readable(0.0):
            self._read()
        now_s = time.monotonic()
        if self._reply is not None or (self._unanswered and now_s - self._since_s > _SILENT_S):
            return False
        if not self._unanswered and now_s - self._since_s > _SILENT_S / 2:
            self._since_s = now_s
            self.send(protocol.Ping())
        return True

    @property
    def may_turn(self) -> bool:
        """Whether the process that waits at the other end is not stopped, as far as is known."""
        return not self._first or process_state(self._first) not in "TtXZ"

    def send(self, request: Request) -> None:
        """Send a request."""
        self.sent = True
        self._unanswered += 1
        try:
            self._connection.send(msgspec.json.encode(request))
        except OSError as error:  # it has just ended, or does not empty its queue
            self._end(Reply(error=f"takes no request ({error.strerror})"))

    def reply(self, wait_s: float = 0.0) -> Reply | None:
        """Return the answer, or None if there is none after so many seconds."""
        until_s = time.monotonic() + wait_s
        while self._reply is None:
            if not self._is_readable(max(0.0, until_s - time.monotonic())):
                return None
            self._read()
        return self._reply

    def _is_readable(self, wait_s: float) -> bool:
        poll = select.poll()
        poll.register(self._connection, select.POLLIN)
        return bool(poll.poll(wait_s * 1000))

    def withdraw(self) -> Reply:
        """Take the requests back, unless they are answered; see above why that is certain."""
        if self._reply is None:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RD)
        while self._reply is None:
            self._read()
        return self._reply

    def ask(self, request: Request, wait_s: float) -> Reply | None:
        """Send one request, and return the answer if there is one within so many seconds."""
        self.send(request)
        reply = self.reply(wait_s)
        self.close()
        return reply

    def close(self) -> None:
        """Forget it, answered or not."""
        self._connection.close()

    def dismiss(self) -> None:
        """Have the process end that waits at the other end, also if it is stopped or hangs."""
        for pid in {self.withdraw().sender, self._first} - {0}:
            process = find_process(pid)
            if process is not None and process.names[0].startswith(WAITING):
                kill(pid)

    def _read(self) -> None:
        sender = 0
        try:
            data, sender = receive_signed(self._connection, protocol.MAX_DATAGRAM)
            self._unanswered -= 1
            if data and (self._unanswered > 0 or self.waits):
                self._first = sender
                return
            reply = msgspec.json.decode(data, type=Reply) if data else Reply(error="no answer")
        except OSError as error:
            reply = Reply(error=f"no answer ({error.strerror})")
        except UNREADABLE:
            reply = Reply(error="its answer makes no sense")
        self._end(msgspec.structs.replace(reply, sender=sender))

    def _end(self, reply: Reply) -> None:
        self._reply = reply
        self._connection.close()


class SpawnerClient:
    """Talks to the spawners of one run. No call waits longer than some tens of milliseconds.

    Args:
        folder: of the run.
        port: base port of the run.
        launcher: pid of its launcher.
    """

    def __init__(self, folder: str, port: int, launcher: int) -> None:
        self.folder = folder
        self._port = port
        self._launcher = launcher
        self._forks: dict[tuple[str, ...], tuple[int, _Asked]] = {}
        self._pings: dict[str, _Asked] = {}
        self._ready: dict[tuple[str, ...], tuple[int, _Asked]] = {}
        self._slow: set[str] = set()

    def fork(self, names: tuple[str, ...], incarnation: int) -> int:
        """Fork a process for the named actors and return its pid.

        Args:
            names: of the actors.
            incarnation: of the process.

        Raises:
            SpawnerBusyError: none has answered yet; to be called again with the same names and
                incarnation, which goes on waiting.
            SpawnerUnavailableError: no spawner could do it, or none has answered for long.
        """
        if child := self._promoted(names, incarnation):
            return child
        asked = self._resumed(names, incarnation)
        queue = [n for n in sorted(NAMES, key=lambda n: n in self._slow)
                 if names != (f"spawner_{n}",) and (asked is None or n != asked.spawner)]
        failures: list[str] = []
        while asked is not None or (asked := self._reach(queue, failures)) is not None:
            if not asked.sent:
                asked.send(protocol.ForkRequest(names, incarnation))
            reply, other = asked.reply(0.0 if asked.spawner in self._slow else WAIT_S), None
            if reply is None:
                self._slow.add(asked.spawner)
                if asked.overdue or not self._slow.issuperset(queue):
                    other = self._reach(queue, failures)
                    if other is not None and asked.overdue:
                        other.patience_s = 2 * asked.patience_s
                if other is None:
                    self._forks[names] = (incarnation, asked)
                    kind = SpawnerUnavailableError if asked.overdue else SpawnerBusyError
                    raise kind(f"spawner_{asked.spawner}: no answer yet")
                reply = asked.withdraw()
            if child := self._child(reply, names, incarnation):
                self._slow.discard(asked.spawner)
                if other is not None:
                    other.close()
                return child
            failures.append(f"spawner_{asked.spawner}: {reply.error or 'a stranger answers'}")
            asked = other
        raise SpawnerUnavailableError("; ".join(failures))

    def prepare(self, names: tuple[str, ...], incarnation: int, kind: Waits) -> None:
        """Have a process made ready that `fork` makes the node; if that is not possible, none is.

        Until then it is silent. Another incarnation, or `forget`, ends it.
        """
        self.forget(names)
        asked = self._reach([name for name in NAMES if name not in self._slow], [])
        if asked is not None:
            asked.waits, asked.rehearses = True, kind == "own"
            asked.send(protocol.ForkRequest(names, incarnation, kind))
            self._ready[names] = incarnation, asked

    def is_ready(self, names: tuple[str, ...]) -> bool:
        """Whether a process was made ready and turns, as far as is known."""
        _, asked = self._ready.get(names, (0, None))
        if asked is not None and not asked.turns():
            self.forget(names)
        return names in self._ready

    def set_up(self, names: tuple[str, ...]) -> bool:
        """Have the process that was made ready set its actors up; False if it has, or is none."""
        _, asked = self._ready.get(names, (0, None))
        if asked is None or not asked.rehearses:
            return False
        asked.rehearses = False
        asked.send(protocol.SetUp())
        return True

    def forget(self, names: tuple[str, ...]) -> None:
        """End the process that was made ready, if there is one."""
        _, asked = self._ready.pop(names, (0, None))
        if asked is not None:
            asked.dismiss()

    def withdraw(self, names: tuple[str, ...]) -> None:
        """End what is under way for these actors: what was made ready, and what was asked for."""
        self.forget(names)
        before, asked = self._forks.pop(names, (0, None))
        if asked is not None and (child := self._child(asked.withdraw(), names, before)):
            kill(child)

    def turns(self, name: str) -> bool:
        """Whether a spawner answers; one that does not is asked once, however often this is."""
        asked, wait_s = self._pings.pop(name, None), 0.0
        if asked is None:
            asked, wait_s = self._reach([name], []), WAIT_S
            if asked is None:
                return False
            asked.send(protocol.Ping())
        reply = asked.reply(wait_s)
        if reply is None:
            self._pings[name] = asked
        return reply is not None and not reply.error

    def set_origin(self, origin_s: float) -> None:
        """Tell the first spawner when simulated time starts.

        Raises:
            SpawnerUnavailableError: it does not answer.
        """
        asked = self._reach([NAMES[0]], [])
        reply = asked.ask(protocol.SetOrigin(origin_s), START_PATIENCE_S) if asked else None
        if reply is None or reply.error:
            raise SpawnerUnavailableError("spawner_a: no answer")

    def adapt(self, adapted: AdaptedSystem) -> None:
        """Have every process that is forked from now on know a changed system.

        Raises:
            OSError: the folder of the run is full, or gone.
        """
        change_system(self.folder, msgspec.json.encode(adapted))
        for names in list(self._ready):  # they know the system as it was
            self.forget(names)

    def close(self) -> None:
        """Withdraw what is under way."""
        for _, asked in self._forks.values():
            asked.withdraw()
        for asked in self._pings.values():
            asked.close()
        for names in list(self._ready):
            self.forget(names)
        self._forks.clear()
        self._pings.clear()

    def _promoted(self, names: tuple[str, ...], incarnation: int) -> int:
        """Make the process that is ready the node and return its pid; 0 if there is none."""
        of, asked = self._ready.pop(names, (0, None))
        if asked is None:
            return 0
        if of == incarnation:
            asked.waits = False
            asked.send(protocol.Go())
            reply = asked.reply(_GO_S)
            if reply is None and asked.may_turn:
                reply = asked.reply(WAIT_S)
            reply = reply or asked.withdraw()
            if child := self._child(reply, names, incarnation):
                return child
        asked.dismiss()
        return 0

    def _resumed(self, names: tuple[str, ...], incarnation: int) -> _Asked | None:
        before, asked = self._forks.get(names, (incarnation, None))
        if before != incarnation:  # its place is another's now
            self.withdraw(names)
            return None
        self._forks.pop(names, None)
        return asked

    def _child(self, reply: Reply, names: tuple[str, ...], incarnation: int) -> int:
        """Return who sent an answer, if that is the process that was asked for; else 0."""
        process = find_process(reply.sender) if reply.sender and not reply.error else None
        if process is None or (process.port, process.launcher) != (self._port, self._launcher):
            return 0
        return process.pid if (process.names, process.incarnation) == (names, incarnation) else 0

    def _reach(self, names: list[str], failures: list[str]) -> _Asked | None:
        """Connect to the first of these spawners that is there; takes those tried off the list."""
        while names:
            name = names.pop(0)
            try:
                connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            except OSError as error:
                failures.append(f"spawner_{name}: {error.strerror}")
                continue
            try:
                connection.setblocking(False)  # who does not accept must not keep us
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
                connection.connect(protocol.address(self.folder, name))
                if is_same_user(connection):
                    return _Asked(name, connection)
                failures.append(f"spawner_{name}: its name is taken by another user")
            except OSError as error:
                failures.append(f"spawner_{name}: not there ({error.strerror})")
            connection.close()
        return None
