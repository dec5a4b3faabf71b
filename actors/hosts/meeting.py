"""How the launchers of a run come together: the others ask the first host's.

A connection for each host, over which lines of JSON go, a question and its answer. By them a
launcher learns of the plan of the run, whether its own files are the same, when simulated time
begins, what time it is, and when the run is over. A connection that breaks is made again; the run
does not depend on it.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import ssl
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec

import rampart
from rampart.actors.access.register import Kind, read_register
from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.zenoh_session import Credentials
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, load_document, on_host
from rampart.files.reading import plain_line

PERIOD_S = 0.25
"""Real seconds between two questions."""

DOOR = ROUTERS[0]
"""By whose certificate the first host's launcher is known: routers have those of servers."""

_PATIENCE_S = 3.0
"""For an answer, or for the next question: then the connection is made again."""

_FAREWELL_S = 2.0
"""How long others are waited for at the end: over a bad line the word is sent again and again."""

_GOODBYE_S = 0.5
"""How long a connection that is closed waits for the other end's word that it has heard so."""

_MAX_LINE = 1 << 20


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

    `refused` says why the host may not take part, `over` why the run has ended; both end it.
    `now_s` and `origin_s` are readings of the first host's monotonic clock, `origin_s` at simulated
    time 0, None before that is known. `waits_for` names the hosts that are missing.
    """

    plan: RunPlan
    starts: int = 1
    now_s: float = 0.0
    origin_s: float | None = None
    waits_for: tuple[str, ...] = ()
    incarnations: dict[str, int] = {}
    refused: str = ""
    over: str = ""


class MeetingError(Exception):
    """A host cannot take part; the text is one line for the user."""


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
        self._serials: dict[str, list[str]] = {host: [] for host in hosts}
        self._ready: dict[str, bool] = dict.fromkeys(hosts, False)
        self._changed = asyncio.Event()
        self._origin_s: float | None = None
        self._over = ""
        self._server: asyncio.Server | None = None
        self._shown: Credentials | None = None
        self._told: dict[str, asyncio.Event] = {}
        self._writers: set[asyncio.StreamWriter] = set()

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
        try:
            self._server = await asyncio.start_server(
                self._serve, address, port, limit=_MAX_LINE, reuse_address=True,
                ssl=context(shown, ssl.Purpose.CLIENT_AUTH) if shown else None,
                ssl_shutdown_timeout=_GOODBYE_S if shown else None)
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
        self._over = "the first host has ended it"
        waiting = [one.wait() for one in self._told.values()]
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(asyncio.gather(*waiting), _FAREWELL_S)
        if self._server is not None:
            self._server.close()
        for writer in list(self._writers):
            await _closed(writer)

    def _missing(self) -> tuple[str, ...]:
        return tuple(host for host, ready in self._ready.items() if not ready)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        told_of_end, host = asyncio.Event(), ""
        self._writers.add(writer)
        try:
            while True:
                line = await asyncio.wait_for(reader.readuntil(), _PATIENCE_S)
                ask = msgspec.json.decode(line, type=Ask)
                host = ask.host
                if self._shown and not _is(writer, self._shown, "node", on_host(OBSERVER, host)):
                    raise ValueError(f"somebody else asks for host {host}")
                self._told[host] = told_of_end
                answer = self._answer(ask)
                writer.write(msgspec.json.encode(answer) + b"\n")
                await writer.drain()
                if answer.over or answer.refused:
                    return
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError,
                *UNREADABLE):
            return  # it is gone, or nobody of ours
        finally:
            told_of_end.set()
            if self._told.get(host) is told_of_end:
                del self._told[host]
                if host in self._ready and self._origin_s is None:
                    self._ready[host] = False
                    self._changed.set()
            self._writers.discard(writer)
            await _closed(writer)

    def _answer(self, ask: Ask) -> Told:
        if ask.host not in self._ready:
            return Told(self._plan, refused=f"no host {ask.host!r} waits to take part; known: "
                        f"{', '.join(self._ready)}")
        if differs := _difference(self._contents, ask):
            return Told(self._plan, refused=differs)
        serials = self._serials[ask.host]
        if ask.serial not in serials:
            if ask.host in self._told and serials and self._ready[ask.host] and (
                    self._origin_s is None):
                return Told(self._plan, refused=f"host {ask.host} takes part already")
            serials.append(ask.serial)
        elif ask.serial != serials[-1]:
            return Told(self._plan, refused=f"host {ask.host} was started anew")
        if ask.is_ready and not self._ready[ask.host]:
            self._ready[ask.host] = True
            self._changed.set()
        return Told(self._plan, len(serials), time.monotonic(), self._origin_s, self._missing(),
                    self._issued() if not ask.is_ready else {}, over=self._over)


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
        self._ends: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    def ready(self, contents: Mapping[str, str]) -> None:
        """Be ready to start from the next question on, with these files."""
        self._ask = msgspec.structs.replace(self._ask, contents=dict(contents), is_ready=True)

    async def ask(self) -> tuple[Told, float, float]:
        """Ask once; return the answer, and when it was asked for and heard, on this host's clock.

        Raises:
            OSError: it cannot be reached, or does not answer; the next question may.
            MeetingError: this host may not take part.
        """
        try:
            async with asyncio.timeout(_PATIENCE_S):
                if self._ends is None:
                    self._ends = await asyncio.open_connection(
                        *self._where, limit=_MAX_LINE, ssl=self._context,
                        ssl_shutdown_timeout=_GOODBYE_S if self._context else None)
                    if self._shown and not _is(self._ends[1], self._shown, "router", DOOR):
                        raise MeetingError("somebody else answers in the first host's place")
                reader, writer = self._ends
                asked_s = time.monotonic()
                writer.write(msgspec.json.encode(self._ask) + b"\n")
                line = await reader.readuntil()
                heard_s = time.monotonic()
                told = msgspec.json.decode(line, type=Told)
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, *UNREADABLE) as error:
            await self.close()
            raise OSError(f"no answer ({error})") from None
        except (OSError, TimeoutError):
            await self.close()
            raise
        if told.refused:
            await self.close()
            raise MeetingError(plain_line(told.refused))
        return told, asked_s, heard_s

    async def close(self) -> None:
        """Close the connection; the next question makes another one."""
        ends, self._ends = self._ends, None
        if ends is not None:
            await _closed(ends[1])


_OWN = (*(name for name in RunPlan.__struct_fields__ if name.startswith("hmi_")),
        "base_port", "launcher_pid", "folder", "audit_log", "error_log", "origin_s", "checkpoints",
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
    hashes = {"rampart": _program(), "specification": _hash(msgspec.json.encode(_sorted(document)))}
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


def _is(writer: asyncio.StreamWriter, shown: Credentials, kind: Kind, identity: str) -> bool:
    """Whether the certificate at the other end is that of an identity, and not revoked."""
    certificate = writer.get_extra_info("peercert") or {}
    names = [value for part in certificate.get("subject", ()) for name, value in part
             if name == "commonName"]
    register = read_register(Path(shown.authority).parent)
    return names == [register.of_kind(kind).get(identity)]


async def _closed(writer: asyncio.StreamWriter) -> None:
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()


def _program() -> str:
    root = Path(rampart.__file__).parent
    whole = hashlib.sha256()
    for top in sorted(root.iterdir()):
        for file in sorted(top.resolve().rglob("*.py")) if top.is_dir() else ():
            whole.update(file.relative_to(top.resolve()).as_posix().encode() + file.read_bytes())
    return whole.hexdigest()


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _sorted(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _sorted(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [_sorted(one) for one in value]
    return value
