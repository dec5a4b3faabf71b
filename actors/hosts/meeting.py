"""Rendezvous of the launchers of a run: those of the other hosts ask the first host's.

Each of them sends questions over a WebSocket. The answers carry the plan of the run, whether this
host's files are the same, when simulated time begins, and the first host's clock. At the end of the
run the first host closes all connections with a special close code. A broken connection is made
again; the run does not depend on it.
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
"""Identity of the first host's launcher: a router's, since those certificates are for servers."""

_TIMEOUT_S = 3.0
"""For a connection, an answer, and a pair of keepalives; real seconds."""

_SERVER_CLOSE_S, _CLIENT_CLOSE_S = 2.0, 0.5
"""Longest wait for the other end while closing; a bad line delivers late."""

_LOOK_S = 0.1
"""Real seconds between two checks whether all hosts are ready."""

_OVER = 4000
"""Close code: the first host has ended the run, for the reason given with it."""

_QUIET = logging.getLogger("rampart.hosts.meeting")
_QUIET.disabled = True  # connections of strangers are not the user's concern

_SETTINGS: dict[str, Any] = {
    "compression": None, "max_size": 1 << 20, "logger": _QUIET, "open_timeout": _TIMEOUT_S}


class Question(msgspec.Struct, frozen=True):
    """Host, hashes of its files, whether it is ready; `serial` differs for each start of a host."""

    host: str
    serial: str
    contents: dict[str, str]
    is_ready: bool = False


class Answer(msgspec.Struct, frozen=True):
    """The first host's answer.

    `refused` is the reason why the host may not take part. `starts` counts the starts of that host.
    `now_s` and `origin_s` are readings of the first host's monotonic clock, `origin_s` at simulated
    time 0; None before that is known. `waits_for` names the missing hosts.
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
    """The first host has ended the run; the text is the reason."""


@dataclass(slots=True)
class _Guest:
    """Another host: the serials of its starts, the present one last, and its connection."""

    serials: list[str] = field(default_factory=list)
    connection: ServerConnection | None = None
    is_ready: bool = False


class Meeting:
    """The first host's side.

    Args:
        plan: Of the run. The others get it without what is this host's own.
        hosts: Names of the others.
        contents: Hashes of this host's files.
        issued: Returns the incarnation of each node that was issued last.
    """

    def __init__(self, plan: RunPlan, hosts: tuple[str, ...], contents: Mapping[str, str],
                 issued: Callable[[], dict[str, int]]) -> None:
        self._plan = joined(plan, RunPlan())
        self._contents = dict(contents)
        self._issued = issued
        self._guests = {host: _Guest() for host in hosts}
        self._origin_s: float | None = None
        self._server: Server | None = None
        self._credentials: Credentials | None = None

    async def open(self, address: str, port: int, credentials: Credentials | None = None) -> None:
        """Listen at an address, with credentials unless the run has no keys.

        Raises:
            MeetingError: The address is not one of this machine's, or in use.
        """
        self._credentials = credentials
        tls: dict[str, Any] = {
            "ssl": tls_context(credentials, ssl.Purpose.CLIENT_AUTH),
            "ssl_handshake_timeout": _TIMEOUT_S} if credentials else {}
        try:
            self._server = await serve(
                self._serve, address, port, origins=[None],  # no page in a browser
                close_timeout=_SERVER_CLOSE_S, ping_interval=_TIMEOUT_S / 2,
                ping_timeout=_TIMEOUT_S / 2, **tls, **_SETTINGS)
        except OSError as error:
            raise MeetingError(f"cannot listen at {address} port {port} for the other hosts: "
                               f"{error.strerror or error}") from None

    async def all_ready(self, report: Callable[[str], None], is_unwanted: Callable[[], bool]
                        ) -> bool:
        """Wait until all others are ready, and report the missing ones; False if unwanted."""
        reported = ""
        while missing := self._missing():
            line = f"waiting for {', '.join(missing)}: rampart run --host {missing[0]} there"
            if line != reported:
                report(line)
                reported = line
            if is_unwanted():
                return False
            await asyncio.sleep(_LOOK_S)
        return True

    def begin(self, origin_s: float) -> None:
        """Let the others know when simulated time begins."""
        self._origin_s = origin_s

    async def close(self) -> None:
        """Notify the others that the run is over, as far as they can be reached soon."""
        if self._server is not None:
            self._server.close(code=_OVER, reason="the first host has ended it")
            with contextlib.suppress(TimeoutError):  # a client is still connecting
                await asyncio.wait_for(self._server.wait_closed(), 2 * _SERVER_CLOSE_S)

    def _missing(self) -> tuple[str, ...]:
        return tuple(host for host, guest in self._guests.items() if not guest.is_ready)

    async def _serve(self, connection: ServerConnection) -> None:
        try:
            async for message in connection:
                question = msgspec.json.decode(message, type=Question)
                if self._credentials and not _is(
                        connection, self._credentials, "node", on_host(OBSERVER, question.host)):
                    return
                answer = self._answer(question, connection)
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

    def _answer(self, question: Question, connection: ServerConnection) -> Answer:
        host, guest = question.host, self._guests.get(question.host)
        if guest is None:
            return Answer(self._plan, refused=f"no host {host!r}; this run waits for "
                          f"{', '.join(self._guests)}")
        if difference := _difference(self._contents, question):
            return Answer(self._plan, refused=difference)
        if question.serial not in guest.serials:
            if guest.is_ready and self._origin_s is None:
                return Answer(self._plan, refused=f"host {host} takes part already")
            guest.serials.append(question.serial)
        elif question.serial != guest.serials[-1]:
            return Answer(self._plan, refused=f"host {host} was started again since")
        guest.connection = connection
        guest.is_ready |= question.is_ready
        return Answer(self._plan, len(guest.serials), time.monotonic(), self._origin_s,
                      self._missing(), {} if question.is_ready else self._issued())


class Attendance:
    """Another host's side.

    Args:
        host: Its name.
        where: Address and port of the first host.
        contents: Hashes of this host's files.
        credentials: None in a run without keys.
    """

    def __init__(self, host: str, where: tuple[str, int], contents: Mapping[str, str],
                 credentials: Credentials | None = None) -> None:
        self._question = Question(host, f"{time.time_ns()}", dict(contents))
        self._where = where
        self._credentials = credentials
        self._context = tls_context(
            credentials, ssl.Purpose.SERVER_AUTH) if credentials else None
        self._connection: ClientConnection | None = None

    def ready(self, contents: Mapping[str, str]) -> None:
        """Be ready to start from the next question on, with these files."""
        self._question = msgspec.structs.replace(
            self._question, contents=dict(contents), is_ready=True)

    async def ask(self) -> tuple[Answer, float, float]:
        """Ask once; return the answer, and this host's clock when it asked and was answered.

        Raises:
            OSError: The first host does not answer; it may answer the next question.
            RunOverError: The first host has ended the run.
            MeetingError: This host may not take part.
        """
        try:
            async with asyncio.timeout(_TIMEOUT_S):
                connection = self._connection = self._connection or await self._connected()
                sent_s = time.monotonic()
                await connection.send(msgspec.json.encode(self._question))
                answer = msgspec.json.decode(await connection.recv(), type=Answer)
                received_s = time.monotonic()
        except (OSError, WebSocketException, *UNREADABLE) as error:
            await self.close()
            if (isinstance(error, ConnectionClosed) and error.rcvd is not None
                    and error.rcvd.code == _OVER):
                raise RunOverError(one_line(error.rcvd.reason)) from None
            if isinstance(error, OSError):
                raise
            raise OSError(f"no answer ({error})") from None
        if answer.refused:
            await self.close()
            raise MeetingError(one_line(answer.refused))
        return answer, sent_s, received_s

    async def _connected(self) -> ClientConnection:
        scheme = "wss" if self._context else "ws"
        connection = await connect(
            f"{scheme}://rampart/", host=self._where[0], port=self._where[1], ssl=self._context,
            proxy=None, close_timeout=_CLIENT_CLOSE_S, ping_interval=None, **_SETTINGS)
        if self._credentials and not _is(connection, self._credentials, "router", DOOR):
            await connection.close()
            raise MeetingError(f"the launcher at {self._where[0]} port {self._where[1]} has not "
                               f"the certificate of {DOOR}, so it is not the first host's")
        return connection

    async def close(self) -> None:
        """Close the connection; the next question makes another one."""
        connection, self._connection = self._connection, None
        if connection is not None:
            await connection.close()


_OWN = ("page", "base_port", "launcher_pid", "folder", "error_log", "origin_s", "checkpoints",
        "system_file", "host", "incarnations", "keys", "ports")
"""Fields of a plan that each host has for itself."""


def joined(plan: RunPlan, own: RunPlan) -> RunPlan:
    """Return the plan of a run with a host's own fields."""
    return msgspec.structs.replace(plan, **{name: getattr(own, name) for name in _OWN})


def contents_of(plan: RunPlan, application: Application | None = None) -> dict[str, str]:
    """Return hashes of the files that all hosts share: program, system, application.

    Args:
        plan: Of the run.
        application: None before its options are known.

    Raises:
        SpecificationError: The system's specification is not TOML.
        OSError: A file cannot be read.
    """
    document = load_document(msgspec.structs.replace(plan, strategy="", shadow=""))
    specification = msgspec.json.encode(document, order="sorted")
    hashes = {"rampart": _program(), "specification": _hash(specification)}
    for name, path in application.documents() if application else ():
        hashes[name] = _hash(path.read_bytes())
    return hashes


def _difference(ours: Mapping[str, str], question: Question) -> str:
    """Return which files differ, "" if none does."""
    theirs = question.contents
    different = [name for name in ({**ours, **theirs} if question.is_ready else theirs)
                 if ours.get(name) != theirs.get(name)]
    if not different:
        return ""
    return (f"{', '.join(different)}: not the same as on the first host "
            f"({theirs.get(different[0], 'none')[:12]} here, "
            f"{ours.get(different[0], 'none')[:12]} there); copy it from there")


def tls_context(credentials: Credentials, purpose: ssl.Purpose) -> ssl.SSLContext:
    """Return a context of mutual TLS, as on the bus."""
    context = ssl.create_default_context(purpose, cafile=credentials.authority)
    context.load_cert_chain(credentials.own)
    context.check_hostname = False  # `_is` checks the name, whatever the address
    context.verify_mode = ssl.CERT_REQUIRED
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    return context


def _is(connection: ClientConnection | ServerConnection, credentials: Credentials, kind: Kind,
        identity: str) -> bool:
    """Whether the peer has the certificate of an identity, and that is not revoked."""
    certificate = connection.transport.get_extra_info("peercert") or {}
    names = [value for part in certificate.get("subject", ()) for name, value in part
             if name == "commonName"]
    register = read_register(Path(credentials.authority).parent)
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
