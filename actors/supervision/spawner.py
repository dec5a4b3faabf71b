"""The spawner: a process that has imported everything and opened nothing, and forks nodes.

A fork of it is a node in about a millisecond instead of the second that the imports take. It
holds no thread and no Zenoh session (neither survives a fork). It listens on an abstract unix
socket, which leaves no file; any process of the same user that knows the run may ask it to fork.
There are two of them, `a` and `b`: if one dies, the other forks nodes and its own new sibling.

Requests and replies are one JSON datagram each way on a sequenced-packet socket.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import selectors
import signal
import socket
import sys
from collections.abc import Mapping
from typing import Any, NoReturn

import msgspec

from actors.messages import AdaptedSystem
from actors.runtime import streams
from actors.runtime.unix_peer import is_same_user
from actors.supervision.lifeline import kill_leftovers
from actors.supervision.node_process import node_main, wedge
from actors.supervision.process_title import set_title
from actors.supervision.run_plan import (
    Layout,
    RunPlan,
    adapted_system,
    load_shared,
    load_system,
)

NAMES = ("a", "b")
MAX_DATAGRAM = 160_000
"""A changed system spec has to fit; unix sockets take 200 kB by default."""


class ForkRequest(msgspec.Struct, frozen=True, tag="fork"):
    """Fork a process for these actors, or (names = spawner_a / spawner_b) another spawner.

    `known` tells a restarted supervisor the highest incarnation heard of each node, so that a
    node that died together with its supervisor does not come back under an old number.
    """

    names: tuple[str, ...]
    incarnation: int
    known: dict[str, int] = {}


class Ping(msgspec.Struct, frozen=True, tag="ping"):
    """Ask whether the spawner turns."""


class Adapt(msgspec.Struct, frozen=True, tag="adapt"):
    """Fork from now on by a changed system: an encoded `AdaptedSystem`."""

    adapted: str


class SetOrigin(msgspec.Struct, frozen=True, tag="origin"):
    """Set simulated time 0; sent once by the launcher before the first fork."""

    origin_s: float


class Reply(msgspec.Struct, frozen=True):
    """Answer: the spawner's own pid, the child's (0 if none), and what went wrong if anything."""

    spawner: int
    child: int = 0
    error: str = ""


Request = ForkRequest | Ping | SetOrigin | Adapt


def address(port: int, name: str) -> str:
    """Return the abstract socket address of a spawner of the run on a base port."""
    return f"\0rampart.{port}.spawner.{name}"


class Spawner:
    """The fork server of one run."""

    def __init__(self, name: str, layout: Layout, shared: Mapping[str, Any], lifeline: int) -> None:
        self.name = name
        self._layout = layout
        self._shared = shared
        self._lifeline = lifeline
        self._selector = selectors.DefaultSelector()
        self._listener: socket.socket | None = None
        self._wakeup: tuple[socket.socket, socket.socket] | None = None

    def open(self) -> None:
        """Take the name and the address.

        Raises:
            OSError: another run has the address.
        """
        plan = self._layout.plan
        set_title(plan.base_port, plan.launcher_pid, (f"spawner_{self.name}",), 1)
        self._listen(address(plan.base_port, self.name))

    def serve(self) -> NoReturn:
        """Serve until the launcher ends."""
        for number in (signal.SIGINT, signal.SIGHUP):  # the launcher's to handle; we see its end
            signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGUSR2, wedge)
        self._reap_on_child_end()
        self._selector.register(self._lifeline, selectors.EVENT_READ, self._launcher_gone)
        while True:
            for key, _ in self._selector.select():
                key.data(key.fileobj)

    def _listen(self, where: str) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(where)
        self._listener.listen(16)
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def _accept(self, listener: socket.socket) -> None:
        connection, _ = listener.accept()
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
            self._selector.unregister(connection)
            connection.close()
            return
        try:
            reply = self._obey(msgspec.json.decode(data, type=Request))
        except (msgspec.MsgspecError, KeyError, ValueError, OSError) as error:
            reply = Reply(os.getpid(), error=f"{type(error).__name__}: {error}")
        with contextlib.suppress(OSError):
            connection.send(msgspec.json.encode(reply))

    def _obey(self, request: Request) -> Reply:
        if isinstance(request, SetOrigin):
            self._layout.plan = msgspec.structs.replace(
                self._layout.plan, origin_s=request.origin_s)
            return Reply(os.getpid())
        if isinstance(request, Ping):
            return Reply(os.getpid())
        if isinstance(request, Adapt):
            adapted = msgspec.json.decode(request.adapted, type=AdaptedSystem)
            self._layout, self._shared = adapted_system(self._layout, self._shared, adapted)
            return Reply(os.getpid())
        for name in request.names:
            if name not in self._layout.members and name not in {f"spawner_{n}" for n in NAMES}:
                return Reply(os.getpid(), error=f"unknown node {name!r}")
        child = os.fork()
        if child == 0:
            self._become(request)
        return Reply(os.getpid(), child)

    def _become(self, request: ForkRequest) -> NoReturn:
        code = 1
        try:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            lifeline = self._lifeline
            for key in list(self._selector.get_map().values()):
                if key.fd != lifeline:
                    key.fileobj.close()  # type: ignore[union-attr]
            if self._wakeup:
                self._wakeup[1].close()
            self._selector.close()
            if request.names[0].startswith("spawner_"):
                name = request.names[0].removeprefix("spawner_")
                sibling = Spawner(name, self._layout, self._shared, lifeline)
                sibling.open()
                sibling.serve()
            code = node_main(
                self._layout, request.names, request.incarnation,
                {**self._shared, "known_incarnations": request.known}, lifeline)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def _reap_on_child_end(self) -> None:
        read_end, write_end = socket.socketpair()
        read_end.setblocking(False)
        write_end.setblocking(False)
        self._wakeup = (read_end, write_end)
        signal.set_wakeup_fd(write_end.fileno(), warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        self._selector.register(read_end, selectors.EVENT_READ, self._reap)

    def _reap(self, read_end: socket.socket) -> None:
        with contextlib.suppress(BlockingIOError):
            read_end.recv(4096)
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass

    def _launcher_gone(self, lifeline: int) -> None:
        if os.read(lifeline, 1):
            return
        kill_leftovers(self._layout.plan.launcher_pid)
        os._exit(0)


def main() -> int:
    """Entry of the first spawner: `python -m actors.supervision.spawner LIFELINE_FD` < plan.

    Prints one line on stdout: a JSON object of all actors' ports when it is ready to fork, or
    `error: …` if the plan cannot be run.
    """
    lifeline = int(sys.argv[1])
    plan = msgspec.json.decode(sys.stdin.buffer.read(), type=RunPlan)
    try:
        spec = load_system(plan)
        layout = Layout(plan, spec)
        shared = load_shared(plan, spec)
    except (ValueError, OSError) as error:
        print("error: " + " ".join(str(error).split()), flush=True)
        return 2
    gc.collect()
    gc.freeze()  # keeps the collector from touching, and so copying, the shared pages
    spawner = Spawner(NAMES[0], layout, shared, lifeline)
    try:
        spawner.open()
        print(msgspec.json.encode(layout.port_of).decode(), flush=True)
        os.dup2(2, 1)  # nobody reads the pipe from here on
        streams.secure()  # and perhaps nobody stderr: that ends no node
        spawner.serve()
    except BrokenPipeError:  # the launcher ended while this was loading: nobody to tell
        os._exit(2)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            print(f"error: port in use: another run has base port {plan.base_port}", flush=True)
            return 2
        raise


if __name__ == "__main__":
    sys.exit(main())
