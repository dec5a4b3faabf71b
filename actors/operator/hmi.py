"""The node of the operator's page: shows the run, and passes on the operator's requests.

A non-control node (paper, section III): it keeps no state and may be restarted at any time. It has
what every system has: nodes, decisions, detections, faults, strategies, signals. A robot's page
derives from it. `state` collects the contents, and `server` serves the page.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import pwd
import secrets
import socket
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from rampart.actors.access.register import KeysError
from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.history import read_history
from rampart.actors.ftm.keeping_up import LINE_S, KeepingUp
from rampart.actors.operator.feed import Feed
from rampart.actors.operator.operating import Operating
from rampart.actors.operator.panels import (
    MAX_PANELS,
    Panel,
    plots_of,
    problem_of,
    read_panels,
    steered,
)
from rampart.actors.operator.picture import Bounds
from rampart.actors.operator.processes import ProcessObserver
from rampart.actors.operator.requests import REQUESTS, RefusedError, Request, ResetRequest
from rampart.actors.operator.state import STALE_S, HmiState
from rampart.actors.operator.system import draw_system
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.parameters import Named, TopicsPublished, named
from rampart.actors.runtime.run_context import NO_SYSTEM
from rampart.actors.web.access import Access, AccessError, is_loopback
from rampart.actors.web.audit import AuditLog
from rampart.actors.web.listening import PortError
from rampart.actors.web.tls import Tls, TlsError
from rampart.actors.web.visitors import Register, Role, Visitor, digest
from rampart.files.plain_text import one_line
from rampart.manager.spec.clearing import reset_role
from rampart.manager.spec.schema import Kind
from rampart.manager.spec.specification import SystemSpec, check_document

if TYPE_CHECKING:
    from rampart.actors.operator.server import PageServer

REPEAT_S = 0.5
"""Simulated seconds between repetitions of unanswered messages."""

TOKEN_HOLDER = "operator"  # noqa: S105 it is a name
"""Name of the visitor on a page with one token."""

SHOWN_FAULTS = 20
"""Most rows of the history of faults."""

_PANELS = Bounds(text=200, items=MAX_PANELS)


class Hmi(Actor):
    """The operator's node.

    Class attributes:
        requests: types of the requests of its page.
        shown: topics that it subscribes to for the page only.
        drawn: those of them with only a newest value; it subscribes when the first page opens.
        panels: of the page, besides common ones and those of the specification.
        files: folder with the JavaScript and CSS of `panels`; None for none.
        badge: name of the connection on the page.
        refuses: why it refuses all requests; "" if it does not.
    """

    class Parameters(Actor.Parameters, frozen=True):
        """Parameters that the loader fills in.

        Attributes:
            panels: panels of the class and of the specification.
            fault_orders: topics on which the page orders faults of the robot.
        """

        panels: tuple[Panel, ...] = ()
        fault_orders: TopicsPublished = ()

    parameters: Parameters
    panels: ClassVar[tuple[Panel, ...]] = ()
    files: ClassVar[Path | None] = None
    badge: ClassVar[str] = "live"
    refuses: ClassVar[str] = ""
    tables = ("panel",)
    is_page = True
    outputs: ClassVar[tuple[Topic[Any], ...]] = (
        ftm_topics.RESET, ftm_topics.ADAPT, bus_topics.INJECT, ftm_topics.SIGNAL)
    requests: ClassVar[tuple[type[Request], ...]] = REQUESTS
    shown: ClassVar[tuple[Topic[Any], ...]] = (
        ftm_topics.ADAPTED_SYSTEM, ftm_topics.PROCESS_EVENT, bus_topics.DIAGNOSTIC,
        ftm_topics.ADAPTATION, bus_topics.INJECTION_REPORT)
    drawn: ClassVar[tuple[Topic[Any], ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for panel in cls.panels:
            if panel.script and not (cls.files and (cls.files / panel.script).is_file()):
                raise ValueError(f"panel {panel.title!r}: script = {panel.script!r}: expected a "
                                 f"file in {cls.__name__}.files = {str(cls.files)!r}")

    @classmethod
    def given(cls, name: str, spec: SystemSpec, file: str) -> dict[str, Any]:
        """Return the panels of class and specification; raises as the base class."""
        panels = (*cls.panels, *read_panels(spec, file))
        if problem := problem_of(panels):
            raise ValueError(f"{file}: {name}: {problem}")
        return {"panels": panels}

    @classmethod
    def completed(cls, parameters: Parameters, topics: Iterable[Topic[Any]],
                  ordered: Iterable[str]) -> Parameters:
        """Return the parameters with panels, plots by default, and the topics of fault orders."""
        return msgspec.structs.replace(
            parameters, panels=parameters.panels or plots_of(topics), fault_orders=tuple(ordered))

    @classmethod
    def named(cls, parameters: Parameters) -> dict[str, list[Named]]:
        """Return the topics of its panels and of its parameters."""
        found = super().named(parameters)
        for panel in parameters.panels:
            for shown in panel.fields():
                found["published" if shown.is_published else "heard"].append(named(
                    shown.key, shown.field, kinds=shown.kinds, row=f"panel {panel.title!r}: "))
        return found

    @classmethod
    def alone_on(cls, parameters: Parameters) -> dict[str, str]:
        """Return the keys of its sticks."""
        return {panel.topic: f"panel {panel.title!r}: stick"
                for panel in parameters.panels if panel.stick}

    @classmethod
    def check_topics(cls, parameters: Parameters, topics: Mapping[str, Topic[Any]]) -> None:
        """Refuse sticks whose messages cannot be built.

        Raises:
            ValueError: a field does not fit; the text names the panel.
        """
        for panel in parameters.panels:
            if panel.stick:
                try:
                    steered(panel, topics[panel.topic])
                except ValueError as error:
                    raise ValueError(f"panel {panel.title!r}: stick: topic {panel.topic}: {error}"
                                     ) from None

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        run, plan = context.run, context.run.plan
        self._system = run.system
        self._port: int = plan.page.port
        self._panels = self.parameters.panels
        self._state = self._make_state()
        self._operating = self._make_operating()
        self._table: fm.NodeTable | None = None
        self._server: PageServer | None = None
        self._tls: Tls | None = None
        self._observer = ProcessObserver(plan.base_port, plan.launcher_pid, plan.host)
        worlds = sorted(n.name for n in run.system.nodes if n.kind is Kind.WORLD)
        self._keeping_up = KeepingUp(run.system.timing, worlds, plan.rate, plan.begins_s)
        self._behind_until_s = 0.0
        self._version = -1
        self._is_seen = False
        self._refused_fields: list[str] = []
        if self._port:
            self._subscribe_panels()
        self._show_system(run.system, run.adapted.version if run.adapted else 0)

    # -- for derived classes ---------------------------------------------------------------------

    def _make_state(self) -> HmiState:
        return HmiState()

    def _make_operating(self) -> Operating:
        return Operating(self, self._state, self._panels)

    def _hello(self) -> dict[str, Any]:
        """Return the first message to a page; it offers only what this announces."""
        return {"type": "hello", "run_id": self.context.run.plan.run_id, "rate": self.clock.rate,
                "badge": self.badge, "system": one_line(self.context.run.system.name),
                "expires": self._expires(), "panels": _PANELS.fit(self._panels)[0],
                "past": self._state.past()}

    def _expires(self) -> tuple[str, float] | None:
        """Return the certificate of the run that expires first, and the time (Unix time)."""
        plan, ends = self.context.run.plan, {}
        if self._tls is not None:
            ends["page"] = self._tls.says.until_s
        if plan.keys:
            with contextlib.suppress(ImportError, KeysError, OSError):
                from rampart.actors.access import key_folder  # noqa: PLC0415 of an extra

                names = (*ROUTERS, *(actor.name for actor in self.context.run.system.actors()))
                ends |= {name: until.timestamp() for name, until
                         in key_folder.lifetimes(Path(plan.keys), names).items()}
        return min(ends.items(), key=lambda end: end[1], default=None)

    def _fulfil(self, request: Request, page: int) -> str | dict[str, Any]:
        """Act on a request of the page with a number, and return the answer.

        Raises:
            RefusedError: it cannot be fulfilled; the text is the reason.
        """
        if not isinstance(request, ResetRequest):
            return self._operating.fulfil(request, page)
        if request.recovery not in self._state.latched:
            waiting = ", ".join(self._state.latched) or "none"
            raise RefusedError(f"{request.recovery[:40]!r} does not wait for a reset; "
                               f"waiting: {waiting}")
        self.publish(ftm_topics.RESET, fm.Reset(request.recovery, self.name))
        return f"reset of {request.recovery} requested"

    def _role(self, request: Request) -> Role:
        """Return the least role for a request; mechanisms may name a higher one for a reset."""
        if isinstance(request, ResetRequest):
            return Role(reset_role(self._system, request.recovery))
        return request.role

    @every(REPEAT_S)
    def _repeat(self) -> None:
        """Repeat unanswered messages."""
        self._operating.repeat()

    def _subscribe_panels(self) -> None:
        """Subscribe to the fields of the panels, once each."""
        kept_s: dict[str, float] = {}
        for panel in self._panels:
            for shown in (field for field in panel.fields() if not field.is_published):
                kept_s[shown.field] = max(panel.kept_s, kept_s.get(shown.field, 0.0))
        for field, past_s in kept_s.items():
            try:
                rate_hz = self.chosen_topic(field.partition(":")[0]).rate_hz
                self.hear_field(field, partial(self._field, field))
            except ValueError as error:  # in a replay, where classes may be missing
                self._refused_fields.append(str(error))
                continue
            silent_s = max(STALE_S, 3 / rate_hz) if rate_hz > 0 else math.inf
            self._state.show_field(field, past_s, silent_s)

    def _field(self, field: str, value: Any, header: Header) -> None:
        self._state.field(field, value, header.stamp, self.clock.now())

    # -- the page -------------------------------------------------------------------------------

    def listens(self, topic: Topic[Any]) -> bool:
        """Return whether to subscribe to a topic now; without a page only to those it needs."""
        return topic not in (self.drawn if self._port else self.shown)

    def on_start(self) -> None:
        """Open the page; if that fails, the node goes on without it."""
        self._repeat()
        if not self._port:
            return
        self._operating.start()
        for why in self._refused_fields:
            self.report_diagnostic("panel", why, self.name)
        try:
            self._server = self._serve()
        except Exception as error:
            known = isinstance(error, (AccessError, PortError, TlsError))
            why = str(error) if known else f"{type(error).__name__}: {error}"
            self.report_diagnostic("operator's page", why, f"port {self._port}")
        else:
            self._operating.drove = self._server.drove

    def _serve(self) -> PageServer:
        from rampart.actors.operator.server import (  # noqa: PLC0415 not without a page
            Handlers,
            PageServer,
        )
        from rampart.actors.web.door import Gate  # noqa: PLC0415 likewise

        page, complain = self.context.run.plan.page, self._complain
        if page.cert:
            self._tls = Tls(Path(page.cert), Path(page.key), complain)
        tls = self._tls
        asks = bool(page.token or page.token_file)
        owner = None if asks else Visitor(_user(), Role.INJECT)
        holder = Visitor(TOKEN_HOLDER, Role.INJECT, digest(page.token))
        register = Register([holder] if page.token else [],
                            Path(page.token_file) if page.token_file else None, complain)
        secret = page.secret or secrets.token_hex(32)
        names = () if is_loopback(page.host) else (socket.gethostname(),)
        access = Access(page.host, self._port, asks, tls is not None, page.unencrypted,
                        (*names, *(tls.says.names if tls else ())), page.behind)
        audit = AuditLog(Path(page.audit_log) if page.audit_log else None, self.clock.now, complain,
                         asyncio.get_running_loop().time)
        operating = self._operating
        return PageServer(
            access, Feed(self._state, self.clock.now, self._hello, self._look),
            Handlers(self.requests, operating.introduction, self._fulfil, operating.left,
                     self.refuses, self._role),
            Gate(register, secret, self._port, owner=owner,
                 tls=tls is not None or page.behind.startswith("https:")), audit,
            tls=tls, files=self.files, complain=complain)

    def _complain(self, why: str) -> None:
        self.report_diagnostic("operator's page", one_line(why), f"port {self._port}")

    def on_stop(self) -> None:
        """Close the page."""
        self._operating.stop()
        if self._server is not None:
            self._server.stop()

    def _look(self) -> None:
        if not self._is_seen:
            self._is_seen = True
            for topic, method in self._handlers:
                if topic in self.drawn:
                    self.hear_after_all(topic, getattr(self, method))
        if self.clock.now() > self._behind_until_s:
            self._state.picture.put("behind", "")
        self._state.picture.put("usage", self._observer.look(self._table))
        if folder := self.context.run.plan.black_box:
            with contextlib.suppress(ValueError):  # the black box reports a damaged file
                self._state.picture.put("history", read_history(Path(folder), SHOWN_FAULTS))

    def _show_system(self, system: SystemSpec, version: int) -> None:
        if self._port and system is not NO_SYSTEM and version > self._version:
            self._version = version
            self._system = system
            self._state.narrator.titles = system.titles
            self._state.picture.put("system", draw_system(system))

    # -- messages -------------------------------------------------------------------------------

    @on(ftm_topics.ADAPTED_SYSTEM)
    def _adapted(self, message: fm.AdaptedSystem, _header: Header) -> None:
        if message.version <= self._version:
            return
        try:
            document = msgspec.json.decode(message.document, type=dict[str, Any])
            system = check_document(document, "changed system")
        except UNREADABLE as error:
            self.report_diagnostic("changed system", one_line(f"not shown: {error}"), self.name)
            return
        self._show_system(system, message.version)

    @on(ftm_topics.MANAGER_STATUS)
    def _manager(self, message: fm.ManagerStatus, _header: Header) -> None:
        self._operating.manager(message)
        self._state.manager(message, self.clock.now())

    @on(ftm_topics.NODES)
    def _nodes(self, message: fm.NodeTable, _header: Header) -> None:
        self._operating.nodes(message)
        self._table = message
        if line := self._keeping_up.take(message, self.clock.now()):
            self._behind_until_s = self.clock.now() + 2 * LINE_S * self.clock.rate
            self._state.picture.put("behind", line)
        self._state.keep("nodes", message, self.clock.now())

    @on(ftm_topics.DECISION)
    def _decision(self, message: fm.DecisionRecord, header: Header) -> None:
        self._state.decision(message, header.stamp)

    @on(ftm_topics.PROCESS_EVENT)
    def _process_event(self, message: fm.ProcessEvent, header: Header) -> None:
        self._state.event(message, header)

    @on(bus_topics.DIAGNOSTIC)
    def _diagnostic(self, message: bm.Diagnostic, header: Header) -> None:
        self._state.event(message, header)
        self._operating.diagnostic(message)

    @on(ftm_topics.ADAPTATION)
    def _adaptation(self, message: fm.AdaptationAnswer, _header: Header) -> None:
        self._operating.answered(message)

    @on(bus_topics.INJECTION_REPORT)
    def _injection(self, message: bm.InjectionReport, _header: Header) -> None:
        self._operating.injected(message)


def _user() -> str:
    """Return the name of this process's user."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a user without a name
        return f"user {os.getuid()}"
