"""The spawner: a process that has imported everything and opened nothing, and forks nodes.

A fork of it is a node in about a millisecond instead of the second that the imports take. It
holds no thread and no Zenoh session (neither survives a fork). It listens on a unix socket in the
folder of the run, where only the run's user gets in, and issues the incarnation of what it forks.
There are two of them, `a` and `b`: if one dies, the other forks nodes and its own new sibling.

Requests and replies are one JSON datagram each way on a sequenced-packet socket. A request to fork
is answered by the new process itself, and by its answer it learns whether it is still wanted: a
caller that does not wait any more has closed the connection (see `spawner_client`).
"""

from __future__ import annotations

import asyncio
import dataclasses
import gc
import os
import selectors
import signal
import socket
import sys
from itertools import chain
from pathlib import Path
from typing import Literal, NoReturn

import msgspec
from msgspec.structs import replace

from rampart.actors.bus.envelope import decoder
from rampart.actors.bus.run_folder import (
    changed_system,
    issue,
    issued,
    mark,
    register_of,
    socket_path,
)
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.machine import turns
from rampart.actors.machine.unix_peer import is_same_user, process_id
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.supervision.node_process import Role, Told, Waits, live, node_main, wedge
from rampart.actors.supervision.process_title import end_run, set_title
from rampart.actors.supervision.spare import Spares, wait
from rampart.actors.system.layout import Layout, adapted_system, load_run, published_keys
from rampart.files import streams, working_folder
from rampart.manager.spec.tables import Supervision

NAMES = ("a", "b")
MAX_DATAGRAM = 160_000
"""The names of the actors of one process have to fit; unix sockets take 200 kB by default."""

_BACKLOG = 64
"""So many may wait to be accepted: all processes of a run, each asked for on a connection."""


class ForkRequest(msgspec.Struct, frozen=True, tag="fork"):
    """Fork a process for these actors, or (names = spawner_a / spawner_b) another spawner."""

    names: tuple[str, ...]
    incarnation: int
    waits: Waits | Literal[""] = ""
    """Not "" if it is to be silent, and to answer now, to pings, to `SetUp` and to `Go`."""


class SetUp(msgspec.Struct, frozen=True, tag="set up"):
    """Set the node up in silence that you may be: its process has ended."""


class Go(msgspec.Struct, frozen=True, tag="go"):
    """Be the node that you were made ready for."""


class Ping(msgspec.Struct, frozen=True, tag="ping"):
    """Ask whether the spawner turns."""


class SetOrigin(msgspec.Struct, frozen=True, tag="origin"):
    """Set simulated time 0; sent once by the launcher before the first fork."""

    origin_s: float


class Reply(msgspec.Struct, frozen=True):
    """Answer: what went wrong, if anything; `sender`, filled in by the reader, is who answered."""

    error: str = ""
    sender: int = 0


Request = ForkRequest | SetUp | Go | Ping | SetOrigin


class Loaded(msgspec.Struct, frozen=True):
    """What the launcher is told of the system that was loaded.

    Attributes:
        names: Of all actors.
        supervision: How often its processes are restarted.
    """

    names: tuple[str, ...]
    supervision: Supervision


def address(folder: str, name: str) -> str:
    """Return the path of the socket of a spawner in the folder of a run."""
    return socket_path(folder, f"spawner_{name}")


class Spawner:
    """The fork server of one run."""

    def __init__(self, name: str, layout: Layout, run: RunContext, lifeline: int) -> None:
        self.name = name
        self._layout = layout
        self._run = run
        self._lifeline = lifeline
        self._selector = selectors.DefaultSelector()
        self._system_read: tuple[int, ...] = ()
        self._spares = Spares(layout.spec.supervision.spares, self._selector, self._be_spare)

    def open(self) -> None:
        """Take the title and the address.

        Raises:
            OSError: there is no folder to listen in.
        """
        self.take_title()
        where = address(self._layout.plan.folder, self.name)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        Path(where).unlink(missing_ok=True)  # of the one that this replaces
        listener.bind(where)
        listener.listen(_BACKLOG)
        self._selector.register(listener, selectors.EVENT_READ, self._accept)

    def take_title(self) -> None:
        """Have /proc show what this process is."""
        plan = self._layout.plan
        set_title(plan.base_port, plan.launcher_pid, (f"spawner_{self.name}",), 1)

    def serve(self) -> NoReturn:
        """Serve until the launcher ends."""
        # It ends with the lifeline; no terminal's foreground is here; the kernel reaps children.
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTTIN, signal.SIGTTOU,
                       signal.SIGCHLD):
            signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGUSR2, wedge)
        self._selector.register(self._lifeline, selectors.EVENT_READ, self._launcher_gone)
        while True:
            for key, _ in self._selector.select(self._spares.look_after()):
                key.data(key.fileobj)

    def _accept(self, listener: socket.socket) -> None:
        try:
            connection, _ = listener.accept()
        except OSError:  # it has gone again, or there is no descriptor left
            return
        if not is_same_user(connection):
            connection.close()
            return
        self._selector.register(connection, selectors.EVENT_READ, self._serve_one)

    def _serve_one(self, connection: socket.socket) -> None:
        try:
            data = connection.recv(MAX_DATAGRAM)
        except OSError:
            data = b""
        if not data:
            self._let_go(connection)
            return
        try:
            request = msgspec.json.decode(data, type=Request)
            self._follow_changes()
            if isinstance(request, ForkRequest):
                self._fork(request, connection)
                return
            self._obey(request)
            reply = Reply()
        except Exception as error:  # whatever is asked, it serves the next one
            reply = Reply(error=f"{type(error).__name__}: {error}")
        _answer(connection, reply)

    def _let_go(self, connection: socket.socket) -> None:
        self._selector.unregister(connection)
        connection.close()

    def _obey(self, request: SetUp | Go | Ping | SetOrigin) -> None:
        if isinstance(request, SetUp | Go):
            raise ValueError("this is no process that waits")
        if isinstance(request, SetOrigin):
            self._layout.plan = replace(self._layout.plan, origin_s=request.origin_s)
            self._spares.end()  # they know the plan as it was

    def _follow_changes(self) -> None:
        """Fork from now on by the system as it was changed last.

        Raises:
            ValueError: it makes no sense, and the one before stays.
        """
        changed = changed_system(self._layout.plan.folder, self._system_read)
        if changed is not None:
            self._system_read, data = changed
            self._layout, self._run = adapted_system(
                self._layout, self._run, msgspec.json.decode(data, type=AdaptedSystem))
            self._spares.end()  # they know the system as it was

    def _fork(self, request: ForkRequest, connection: socket.socket) -> None:
        for name in request.names:
            if name not in {*self._layout.members, *self._layout.routers,
                            *(f"spawner_{n}" for n in NAMES)}:
                raise ValueError(f"unknown node {name!r}")
        may_be_spare = self._layout.spare_of(request.names) != "none"
        if not (may_be_spare and self._spares.take(msgspec.json.encode(request), connection)):
            self._spares.wait_a_moment()
            if os.fork() == 0:
                self._become(request, connection)
        self._let_go(connection)  # the child answers; if it cannot, its end is the answer

    def _become(self, request: ForkRequest, connection: socket.socket) -> NoReturn:
        code = 1
        try:
            self._leave(connection)
            if request.names[0].startswith("spawner_"):
                name = request.names[0].removeprefix("spawner_")
                sibling = Spawner(name, self._layout, self._run, self._lifeline)
                sibling.take_title()
                if not _answer(connection, Reply()):
                    os._exit(0)
                connection.close()
                sibling.open()
                sibling.serve()
            code = node_main(self._layout, self._role(request, connection), self._known(),
                             self._lifeline)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def _leave(self, kept: socket.socket) -> None:
        """Close in a child what is the spawner's."""
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for key in list(self._selector.get_map().values()):
            if key.fd not in {self._lifeline, kept.fileno()}:
                key.fileobj.close()  # type: ignore[union-attr]
        self._selector.close()

    def _known(self) -> RunContext:
        return dataclasses.replace(
            self._run, known_incarnations=issued(self._layout.plan.folder))

    def _role(self, request: ForkRequest, connection: socket.socket) -> Role:
        folder, names = self._layout.plan.folder, request.names

        def told() -> Told:
            try:
                said = msgspec.json.decode(connection.recv(MAX_DATAGRAM), type=Request)
            except (OSError, msgspec.MsgspecError):
                os._exit(0)
            if isinstance(said, Go):
                return Told.BE_THE_NODE
            _answer(connection, Reply())
            return Told.SET_UP if isinstance(said, SetUp) else Told.NOTHING

        def born() -> None:
            if not _answer(connection, Reply()):
                os._exit(0)  # not waited for any more: another one may have its place
            connection.close()
            newest = max(register_of(folder)(name) or 0 for name in names)
            if newest >= request.incarnation:
                os._exit(0)  # asked for too late: a later one had its place, or has
            if self._layout.may_be_marked(names):  # else its end counts when its ports are free
                mark(folder, names)
            issue(folder, names, request.incarnation, process_id(os.getpid()))

        if request.waits:
            _answer(connection, Reply())
        return Role(names, request.incarnation, born, request.waits, told,
                    connection if request.waits else None)

    def _be_spare(self, control: socket.socket) -> NoReturn:
        code = 1
        try:
            self._leave(control)
            plan = self._layout.plan
            set_title(plan.base_port, plan.launcher_pid, (f"spare_{self.name}",), 1)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)

            async def begin(data: bytes, connection: socket.socket,
                            bus: ZenohBus | None) -> int:
                role = self._role(msgspec.json.decode(data, type=ForkRequest), connection)
                return await live(self._layout, role, self._known(), self._lifeline, bus)

            code = asyncio.run(wait(control, plan, begin))
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def _launcher_gone(self, lifeline: int) -> None:
        if os.read(lifeline, 1):
            return
        end_run(self._layout.plan.launcher_pid, self._layout.plan.folder)
        os._exit(0)


def _answer(connection: socket.socket, reply: Reply) -> bool:
    try:
        connection.send(msgspec.json.encode(reply))
    except OSError:
        return False
    return True


def main() -> int:
    """Entry of a spawner that loads: `python -m rampart.actors.supervision.spawner NAME FD` < plan.

    NAME is `a` or `b`, FD the read end of the lifeline.

    Prints one line on stdout: `Loaded` as JSON when it is ready to fork, or `error: …` if the plan
    cannot be run.
    """
    working_folder.admit()
    plan = msgspec.json.decode(sys.stdin.buffer.read(), type=RunPlan)
    working_folder.admit(Path(plan.system_file).parent)
    output = os.dup(1)
    os.set_inheritable(output, False)
    return load_and_serve(sys.argv[1], plan, int(sys.argv[2]), output)


def load_and_serve(name: str, plan: RunPlan, lifeline: int, output: int) -> int:
    """Load a plan, say so, and serve; 2 if that is not possible.

    Args:
        name: `a` or `b`.
        plan: of the run.
        lifeline: read end of the pipe.
        output: takes the line that `main` prints; closed then.
    """
    turns.short()
    try:
        spec = load_system(plan)
        run = load_run(plan, spec)
        layout = Layout(plan, spec, run.application)
        published_keys(spec, layout)
    except (ValueError, OSError) as error:
        os.write(output, f"error: {' '.join(str(error).split())}\n".encode())
        return 2
    heard = chain(layout.topics.values(), *(m.actor.inputs() for m in layout.members.values()))
    for topic in heard:
        decoder(topic.type)  # now, and not in each process when it starts: 2 ms
    gc.collect()
    gc.freeze()  # keeps the collector from touching, and so copying, the shared pages
    try:
        spawner = Spawner(name, layout, run, lifeline)
        spawner.open()
        loaded = Loaded(tuple(layout.members), spec.supervision)
        os.write(output, msgspec.json.encode(loaded) + b"\n")
        os.close(output)  # it is not read from here on
        os.dup2(2, 1)
        streams.secure()  # and stderr perhaps neither: that ends no node
        spawner.serve()
    except BrokenPipeError:  # the launcher ended while this was loading
        os._exit(2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
