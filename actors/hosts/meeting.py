"""How the launchers of a run come together: the others ask the first host's.

Each of them has a WebSocket to the first host's and sends a question now and then. From the answers
a launcher learns the plan of the run, whether its own files are the same, when simulated time
begins, and what time it is on the first host. At its end the first host closes all connections with
a code that means so. A connection that breaks is made again; the run does not depend on it.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import ssl
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed, WebSocketException

import rampart
from rampart.actors.access.register import Kind, read_register
from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.zenoh_session import Credentials
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, load_document, on_host
from rampart.files.plain_text import one_line

PERIOD_S = 0.25
"""Real seconds between two questions."""

DOOR = ROUTERS[0]
"""By whose certificate the first host's launcher is known: routers have those of servers."""

_PATIENCE_S = 3.0
"""To connect, for an answer, and for the sign that the other end is there."""

_FAREWELL_S, _GOODBYE_S = 2.0, 0.5
"""How long first and other hosts wait for the other end as they close: a bad line delivers late."""

_OVER = 4000
"""Close code: the first host has ended the run, for the reason that is given with it."""

_QUIET = logging.getLogger("rampart.hosts.meeting")
_QUIET.disabled = True  # strangers who connect are not the user's concern

_SETTINGS: dict[str, Any] = {
    "compression": None, "max_size": 1 << 20, "logger": _QUIET, "open_timeout": _PATIENCE_S}


class Ask(msgspec.Struct, frozen=True, tag="ask"):
    """What a launcher asks: which host it is of, what files it has, and how far it is.

    `serial` is a number of that process's own choice: another one is another start of the host.
    """

    host: str
    serial: str
    contents: dict[str, str]
    is_ready: bool = False


class Told(msgspec.Struct, frozen=True, tag="told"):
    """The answer.

    `refused` says why the host may not take part. `now_s` and `origin_s` are readings of the first
    host's monotonic clock, `origin_s` at simulated time 0, None before that is known. `waits_for`
    names the hosts that are missing.
    """

    plan: RunPlan
    starts: int = 1
    now_s: float = 0.0
    origin_s: float | None = None
    waits_for: tuple[str, ...] = ()
    incarnations: dict[str, int] = {}
    refused: str = ""


class MeetingError(Exception):
    """A host cannot take part; the text is one line for the user."""


class RunOverError(MeetingError):
    """The first host has ended the run; the text says why."""


@dataclass(slots=True)
class _Guest:
    """Another host, as the first one knows it.

    Attributes:
        serials: of its starts, the present one last.
        connection: by which it asks; None if there is none.
        is_ready: whether it waits for the start of the run.
    """

    serials: list[str] = field(default_factory=list)
    connection: ServerConnection | None = None
    is_ready: bool = False


class Meeting:
    """The first host's side.

    Args:
        plan: of the run; others get it without what is this host's own.
        hosts: names of the others.
        contents: what the files of this host are.
        issued: returns the incarnation of each node that was issued last.
    """

    def __init__(self, plan: RunPlan, hosts: tuple[str, ...], contents: Mapping[str, str],
                 issued: Callable[[], dict[str, int]]) -> None:
        self._plan = shared(plan)
        self._contents = dict(contents)
        self._issued = issued
        self._guests = {host: _Guest() for host in hosts}
        self._changed = asyncio.Event()
        self._origin_s: float | None = None
        self._server: Server | None = None
        self._shown: Credentials | None = None

    async def open(self, address: str, port: int, shown: Credentials | None = None) -> None:
        """Listen.

        Args:
            address: at which.
            port: likewise.
            shown: by what this host shows who it is; None in a run without keys.

        Raises:
            MeetingError: the address is not one of this machine's, or in use.
        """
        self._shown = shown
        tls: dict[str, Any] = {
            "ssl": context(shown, ssl.Purpose.CLIENT_AUTH),
            "ssl_handshake_timeout": _PATIENCE_S} if shown else {}
        try:
            self._server = await serve(
                self._serve, address, port, origins=[None],  # no page that a browser shows
                close_timeout=_FAREWELL_S, ping_interval=_PATIENCE_S / 2,
                ping_timeout=_PATIENCE_S / 2, **tls, **_SETTINGS)
        except OSError as error:
            raise MeetingError(f"cannot listen at {address} port {port} for the other hosts: "
                               f"{error.strerror or error}") from None

    async def all_ready(self, say: Callable[[str], None]) -> None:
        """Wait until all others are ready to start, and say for whom."""
        said = ""
        while missing := self._missing():
            line = f"waiting for {', '.join(missing)}: rampart run --host {missing[0]} there"
            if line != said:
                say(line)
                said = line
            self._changed.clear()
            await self._changed.wait()

    def begin(self, origin_s: float) -> None:
        """Tell the others when simulated time begins."""
        self._origin_s = origin_s

    async def close(self) -> None:
        """Tell the others that the run is over, as far as they can be reached soon."""
        if self._server is not None:
            self._server.close(code=_OVER, reason="the first host has ended it")
            with contextlib.suppress(TimeoutError):  # somebody is still connecting
                await asyncio.wait_for(self._server.wait_closed(), 2 * _FAREWELL_S)

    def _missing(self) -> tuple[str, ...]:
        return tuple(host for host, guest in self._guests.items() if not guest.is_ready)

    async def _serve(self, connection: ServerConnection) -> None:
        try:
            async for question in connection:
                ask = msgspec.json.decode(question, type=Ask)
                if self._shown and not _is(
                        connection, self._shown, "node", on_host(OBSERVER, ask.host)):
                    return
                answer = self._answer(ask, connection)
                await connection.send(msgspec.json.encode(answer))
                if answer.refused:
                    return
        except (ConnectionClosed, *UNREADABLE):
            return  # it is gone, or a stranger
        finally:
            for guest in self._guests.values():
                if guest.connection is connection:
                    guest.connection = None
                    guest.is_ready = guest.is_ready and self._origin_s is not None
                    self._changed.set()

    def _answer(self, ask: Ask, connection: ServerConnection) -> Told:
        guest = self._guests.get(ask.host)
        if guest is None:
            return Told(self._plan, refused=f"no host {ask.host!r} waits to take part; known: "
                        f"{', '.join(self._guests)}")
        if differs := _difference(self._contents, ask):
            return Told(self._plan, refused=differs)
        if ask.serial not in guest.serials:
            if guest.is_ready and self._origin_s is None:
                return Told(self._plan, refused=f"host {ask.host} takes part already")
            guest.serials.append(ask.serial)
        elif ask.serial != guest.serials[-1]:
            return Told(self._plan, refused=f"host {ask.host} was started anew")
        guest.connection = connection
        if ask.is_ready and not guest.is_ready:
            guest.is_ready = True
            self._changed.set()
        return Told(self._plan, len(guest.serials), time.monotonic(), self._origin_s,
                    self._missing(), self._issued() if not ask.is_ready else {})


class Attendance:
    """Another host's side.

    Args:
        host: its name.
        where: address and port of the first host.
        contents: what the files of this host are.
        shown: by what it shows who it is; None in a run without keys.
    """

    def __init__(self, host: str, where: tuple[str, int], contents: Mapping[str, str],
                 shown: Credentials | None = None) -> None:
        self._ask = Ask(host, f"{time.time_ns()}", dict(contents))
        self._where = where
        self._shown = shown
        self._context = context(shown, ssl.Purpose.SERVER_AUTH) if shown else None
        self._connection: ClientConnection | None = None

    def ready(self, contents: Mapping[str, str]) -> None:
        """Be ready to start from the next question on, with these files."""
        self._ask = msgspec.structs.replace(self._ask, contents=dict(contents), is_ready=True)

    async def ask(self) -> tuple[Told, float, float]:
        """Ask once; return the answer, and when it was asked for and heard, on this host's clock.

        Raises:
            OSError: it cannot be reached, or does not answer; the next question may.
            RunOverError: it has ended the run.
            MeetingError: this host may not take part.
        """
        try:
            async with asyncio.timeout(_PATIENCE_S):
                connection = self._connection = self._connection or await self._connected()
                asked_s = time.monotonic()
                await connection.send(msgspec.json.encode(self._ask))
                told = msgspec.json.decode(await connection.recv(), type=Told)
                heard_s = time.monotonic()
        except (OSError, WebSocketException, *UNREADABLE) as error:
            await self.close()
            if (isinstance(error, ConnectionClosed) and error.rcvd is not None
                    and error.rcvd.code == _OVER):
                raise RunOverError(one_line(error.rcvd.reason)) from None
            if isinstance(error, OSError):
                raise
            raise OSError(f"no answer ({error})") from None
        if told.refused:
            await self.close()
            raise MeetingError(one_line(told.refused))
        return told, asked_s, heard_s

    async def _connected(self) -> ClientConnection:
        scheme = "wss" if self._context else "ws"
        connection = await connect(
            f"{scheme}://rampart/", host=self._where[0], port=self._where[1], ssl=self._context,
            proxy=None, close_timeout=_GOODBYE_S, ping_interval=None, **_SETTINGS)
        if self._shown and not _is(connection, self._shown, "router", DOOR):
            await connection.close()
            raise MeetingError("somebody else answers in the first host's place")
        return connection

    async def close(self) -> None:
        """Close the connection; the next question makes another one."""
        connection, self._connection = self._connection, None
        if connection is not None:
            await connection.close()


_OWN = ("page", "base_port", "launcher_pid", "folder", "error_log", "origin_s", "checkpoints",
        "system_file", "host", "incarnations", "keys", "ports")
"""Of a plan, what is each host's own."""


def shared(plan: RunPlan) -> RunPlan:
    """Return what all hosts have in common of a plan."""
    return joined(plan, RunPlan())


def joined(plan: RunPlan, own: RunPlan) -> RunPlan:
    """Return the plan of a run with what is a host's own."""
    return msgspec.structs.replace(plan, **{name: getattr(own, name) for name in _OWN})


def contents_of(plan: RunPlan, application: Application | None = None) -> dict[str, str]:
    """Return the hashes of what has to be the same on all hosts: program, system, application.

    Args:
        plan: of the run.
        application: of the run; None as long as the options are not known that it depends on.

    Raises:
        SpecificationError: the system's specification is no TOML.
        OSError: it cannot be read.
    """
    document = load_document(msgspec.structs.replace(plan, strategy="", shadow=""))
    specification = msgspec.json.encode(document, order="sorted")
    hashes = {"rampart": _program(), "specification": _hash(specification)}
    for name, path in application.documents() if application else ():
        hashes[name] = _hash(path.read_bytes())
    return hashes


def _difference(ours: Mapping[str, str], ask: Ask) -> str:
    """Return what is not the same, "" if all is."""
    theirs = ask.contents
    different = [name for name in ({**ours, **theirs} if ask.is_ready else theirs)
                 if ours.get(name) != theirs.get(name)]
    if not different:
        return ""
    return (f"{', '.join(different)}: not the same as on the first host "
            f"({theirs.get(different[0], 'none')[:12]} here, "
            f"{ours.get(different[0], 'none')[:12]} there); copy it from there")


def context(shown: Credentials, purpose: ssl.Purpose) -> ssl.SSLContext:
    """Return how a launcher shows who it is, and has to be shown: mutual TLS, as on the bus."""
    made = ssl.create_default_context(purpose, cafile=shown.authority)
    made.load_cert_chain(shown.own)
    made.check_hostname = False  # the name in the certificate is looked at, whatever its address
    made.verify_mode = ssl.CERT_REQUIRED
    made.minimum_version = ssl.TLSVersion.TLSv1_3
    return made


def _is(connection: ClientConnection | ServerConnection, shown: Credentials, kind: Kind,
        identity: str) -> bool:
    """Whether the certificate at the other end is that of an identity, and not revoked."""
    certificate = connection.transport.get_extra_info("peercert") or {}
    names = [value for part in certificate.get("subject", ()) for name, value in part
             if name == "commonName"]
    register = read_register(Path(shown.authority).parent)
    return names == [register.of_kind(kind).get(identity)]


def _program() -> str:
    root = Path(rampart.__file__).parent
    whole = hashlib.sha256()
    for top in sorted(root.iterdir()):
        for file in sorted(top.resolve().rglob("*.py")) if top.is_dir() else ():
            whole.update(file.relative_to(top.resolve()).as_posix().encode() + file.read_bytes())
    return whole.hexdigest()


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()

