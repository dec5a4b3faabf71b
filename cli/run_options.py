"""Options of `launch.py` and `rampart run`, and the plan of the run.

Start a system from its specification, run it, and write a report with a verdict.
`launch.py` takes the same options.

Examples:
While it runs, use `kill-node`, `rampart inject` and `rampart status` in another shell.

exit code: 0 success and safe; 1 mission failed but safe, or a node was given up or
kept failing; 2 bad usage or unsound system; 3 unsafe; 4 safety not known. Causes of 4
are a missing ground truth, a world that has died, unstable physics, and a killed
process `run`. A report that cannot be written does not change the code; "report_error"
of --json has the reason.
"""

from __future__ import annotations

import argparse
import datetime as dt
import os
import secrets
import socket
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from rampart import systems
from rampart.actors.recording.bag_writer import check_target
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_plan import DEFAULT_PORT, RunPlan, load_system
from rampart.actors.supervision.root import LAST_PORT
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import application_class, load_class
from rampart.actors.web.access import (
    ANY,
    Access,
    AccessError,
    PagePlan,
    check_token,
    is_loopback,
    new_token,
)
from rampart.actors.web.listening import PortError, listen
from rampart.actors.web.tls import Certificate, TlsError, days_left, holds_key, load
from rampart.actors.web.visitors import (
    SecretError,
    VisitorError,
    lists_visitors,
    read_secret,
    read_visitors,
)
from rampart.cli import application_options
from rampart.cli.output import UsageError, between, positive, warn
from rampart.cli.verbs import (
    PORT_VARIABLE,
    add_options,
    extra,
    flag,
    help_of,
    number,
    option,
    port_option,
    several,
    whole,
    word,
)
from rampart.files import working_folder
from rampart.manager.spec.specification import SystemSpec
from rampart.manager.strategies.registry import STRATEGIES
from rampart.sim.faults.faults import faults_of
from rampart.sim.virtual.network import NETWORKS

ERROR_LOG = "errors.log"
HMI = "rampart.actors.operator.hmi:Hmi"

LEAST_RATE, MOST_RATE = 0.1, 20
"""Bounds of --rate, simulated seconds per second."""

SOON = dt.timedelta(days=1)
"""Time before the expiry of a certificate from which a run warns."""

TOKEN_VARIABLE = "RAMPART_HMI_TOKEN"  # noqa: S105 a name

_OF_THE_PAGE = ("hmi_port", "hmi_host", "hmi_token_file", "hmi_cert", "hmi_key", "hmi_unencrypted",
         "hmi_behind")

_SOON_DAYS = 7.0
"""Days before its expiry from which a certificate causes a note."""

_PAGE_OPTIONS = (
    whole("--hmi-port", "PORT", "port of the operator's page (default: 8080)", 8080),
    word("--hmi-host", "HOST", "address of the operator's page (default: 127.0.0.1, this machine "
         "only). Any other address needs a certificate. The page then asks for the token that is "
         "printed at the start of the run", "127.0.0.1"),
    word("--hmi-cert", "FILE", "certificate chain of the page (PEM)", ""),
    word("--hmi-key", "FILE", "private key of the certificate (PEM, mode 0600; default: in the "
         "file of the certificate)", ""),
    flag("--hmi-unencrypted", "serve the page to other machines without encryption: anyone on "
         "that network can read the token and all data"),
    word("--hmi-behind", "ORIGIN", "origin at which a reverse proxy on this machine serves the "
         "page, as https://robot.example; the page asks for a token", ""),
    word("--hmi-token-file", "FILE", "file of mode 0600 with a token of 16 characters or more, or "
         f"the file of `rampart tokens`. The variable {TOKEN_VARIABLE} can hold a token, too "
         "(default: a random token; none on this machine)", ""),
    option("--hmi-token", nargs="?", const="", help=argparse.SUPPRESS))  # refused

_EXAMPLES = (
    ("", "the default system"),
    ("--virtual --seed 7", "in virtual time, in seconds; repeatable"),
    ("--virtual --fault kill:NODE@30 --fault drop:TOPIC@goal2+5", "with faults"),
    ("--rate 4 --no-hmi --json", "four times real time, result as JSON"),
    ("--record run.mcap", "record all messages"),
    ("--no-ftm", "without fault tolerance"),
    ("--hmi-token-file FILE", "with tokens for the page"),
    ("--hmi-host 0.0.0.0 --hmi-cert FILE --hmi-key FILE", "page for other machines"),
    *((f"--system {name}", "a shipped system") for name in systems.names().split(", ")),
)

_OPTIONS = (
    flag("--wait", "start the mission from the operator's page"),
    word("--system", "FILE", f"system file, or name of a shipped system: {systems.names()} "
         "(default: osmosis)", str(systems.DEFAULT)),
    word("--strategy", "NAME", f"strategy: {', '.join(STRATEGIES)} (default: the system's)", ""),
    word("--shadow", "NAME", "second strategy that decides without effect; differing decisions are "
         "recorded (default: the system's)", ""),
    flag("--no-ftm", "run the unprotected baseline: the base keeps the last command, and no "
         "node is restarted"),
    number("--rate", "R",
           f"simulated seconds per second, {LEAST_RATE:g} to {MOST_RATE}; 1 with a robot on the "
           "wall clock (default: 1)", 1.0),
    whole("--seed", "N", "seed of sensor noise and faults (default: 1)", 1),
    flag("--no-hmi", "serve no operator's page; its node runs"),
    *_PAGE_OPTIONS,
    port_option("--port", "base port, which identifies the run on this machine; with --keys, "
                "the routers use free ports from it upwards "
                f"(default: the variable {PORT_VARIABLE}, else {DEFAULT_PORT})", DEFAULT_PORT,
                metavar="PORT"),
    word("--keys", "DIR", "folder of credentials from `rampart keys`: links use mutual TLS, and "
         "routers accept only messages that a certificate permits (default: "
         "none; file permissions exclude other users)", ""),
    number("--patience", "S", "simulated seconds without progress after which the mission counts "
           "as failed (default: 60)", 60.0),
    number("--duration", "S", "simulated seconds after which a system without a mission ends "
           "(default: that of [end], else on interruption)"),
    word("--record", "FILE", "record all messages to an MCAP file"),
    option("--black-box", action=argparse.BooleanOptionalAction, default=None,
           help="keep the time around faults, see `rampart incident` (default: yes, except in "
           "virtual time and on several hosts)"),
    flag("--overwrite", "let --record replace an existing file"),
    flag("--no-keys", "run on several hosts without --keys: every client on the network has "
         "full control"),
    word("--host", "NAME", "the [[host]] that this machine is; the run starts when all hosts "
         "are connected (default: the first)"),
    word("--watchdog", "DEVICE", "watchdog device, such as /dev/watchdog: it resets the machine if "
         "the root, the supervisor or the FTM Manager stays away (default: none)", ""),
    word("--report", "DIR", f"directory of the report, of checkpoints, and of {ERROR_LOG} with "
         "tracebacks (default: reports/TIME-MISSION, without a mission "
         "reports/TIME-SYSTEM)"),
    option("--resume", nargs="?", const="", metavar="RUN", help="continue a run whose root was "
           "killed or whose machine lost power, from its checkpoints and with its options. "
           "RUN is the directory of its report, or its id (default: the newest that did not end); "
           "not with --virtual or several hosts"),
    flag("--virtual", "run in virtual time: all actors in one process, many times faster than "
         "real time; the same --seed gives the same run, to the byte"),
    word("--network", "NAME", "with --virtual: network model "
         f"{', '.join(NETWORKS)} (default: measured)", "measured"),
    several("--fault", "FAULT[@WHEN][+S]", "fault to inject; repeatable. FAULT is a name from "
            "`rampart inject --list`, MODE:TOPIC, kill:NODE, stop:NODE, wedge:NODE, slow:NODE, "
            "hang:NODE, slow:all or stop:all; WHEN is simulated seconds, or goalN "
            "(default: 10); S is the duration"),
    flag("--json", "print the result as a JSON object in the last line of stdout"))


def parser(program: str = "", kind: type[Application] = Application,
           chosen: Mapping[str, Any] | None = None) -> argparse.ArgumentParser:
    """Return the parser of the command line.

    Args:
        program: name of the command.
        kind: the application of the system, which adds options.
        chosen: values of these options in the specification.
    """
    examples = "".join(f"  {program} {how:<40} # {what}\n" for how, what in (
        *_EXAMPLES, *kind.examples))
    shown = help_of(__doc__)  # the examples depend on program and system
    shown["epilog"] = shown["epilog"].replace("examples:\n", f"examples:\n{examples}\n", 1)
    p = argparse.ArgumentParser(prog=program, **shown)
    add_options(p, _OPTIONS)
    application_options.add(p, kind, chosen or {})
    return p


def parse(arguments: Sequence[str] | None, program: str
          ) -> tuple[argparse.Namespace, type[Application]]:
    """Return the options, with those of the application, and the class of the application.

    Args:
        arguments: arguments of the command line; None for those of this process.
        program: name of the command.

    Raises:
        UsageError: the system or an option is unknown.
        ValueError: the specification is not sound.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--system", default=str(systems.DEFAULT))
    system = str(first.parse_known_args(arguments)[0].system)
    spec = load_system(RunPlan(system_file=str(_system_file(system))))
    kind = application_class(spec)
    options, unknown = parser(program, kind, spec.application).parse_known_args(arguments)
    if unknown:
        raise UsageError(f"{unknown[0]}: not an option of the launcher or of {spec.name}; --system "
                         f"{system} --help lists the options")
    return options, kind


def of_one_process(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """Separate the arguments of this process from those of all parts of a resumed run.

    Args:
        arguments: arguments of the command line.

    Returns:
        The run to resume, "" for the newest, None without --resume; and the arguments except those
        of recording, faults and report.
    """
    p = argparse.ArgumentParser(add_help=False)
    p.add_argument("--resume", nargs="?", const="")
    p.add_argument("--record")
    p.add_argument("--overwrite", action="store_true")
    p.add_argument("--report")
    p.add_argument("--fault", action="append")
    known, rest = p.parse_known_args(arguments)
    return known.resume, rest


def _system_file(system: str) -> Path:
    found = systems.find(system)
    if not found.is_file():
        what = "is a directory" if found.is_dir() else "no such file"
        raise UsageError(f"--system {system}: {what}; expected a system file, or the name of a "
                         f"shipped system: {systems.names()}")
    working_folder.admit(found.parent)
    return found


def plan_of(options: argparse.Namespace, kind: type[Application],
            note: Callable[[str], None] = warn) -> tuple[RunPlan, SystemSpec]:
    """Return the plan of the run, and its system.

    Args:
        options: options of the command line.
        kind: the application of the system.
        note: called with each warning.

    Raises:
        UsageError: an option does not fit another one, or the system.
        ValueError: the specification is not sound.
    """
    _check(options)
    system_file = _system_file(options.system)
    host = _host(options, system_file) if options.host is not None else ""
    token = own_token(options)
    plan = RunPlan(
        run_id=uuid.uuid4().hex[:12], base_port=options.port,
        rate=options.rate,
        seed=options.seed, system_file=str(system_file.resolve()), strategy=options.strategy,
        ftm=not options.no_ftm, options=application_options.chosen(options, kind),
        shadow=options.shadow, waits=options.wait, virtual=options.virtual, host=host,
        watchdog=options.watchdog)
    spec = load_system(plan)
    for node in spec.nodes:
        if node.spare not in {"", "none", "pool"}:
            note(f"{system_file}: node {node.name}: spare = {node.spare!r} means 'pool' now")
    layout = Layout(plan, spec)
    _check_rate(plan, layout)
    _check_network(options, spec)
    if options.keys:
        plan = msgspec.structs.replace(plan, keys=_checked_keys(options, layout))
    if not options.no_hmi:
        plan = msgspec.structs.replace(plan, faults=faults_of(spec).offered())
    if not any(issubclass(member.actor, load_class(HMI)) and layout.hosts.home_of[name] == host
               for name, member in layout.members.items()):
        where = f" on host {host or 'the first'}" if layout.hosts.several else ""
        refuse(options, ("wait", *_OF_THE_PAGE),
               f"no node of {spec.name}{where} serves an operator's page")
        return plan, spec
    return msgspec.structs.replace(plan, page=page_of(options, token, note)), spec


def _host(options: argparse.Namespace, system_file: Path) -> str:
    """Return the name of the host that --host names, "" for the first."""
    spec = load_system(RunPlan(system_file=str(system_file)))
    names = [host.name for host in spec.hosts]
    if options.host not in names:
        raise UsageError(f"--host {options.host}: " + (
            f"unknown; known: {', '.join(names)}" if names else
            f"{spec.name} has no [[host]]; it runs on one machine"))
    if options.virtual:
        raise UsageError(f"--host {options.host}: not with --virtual, which runs on one machine")
    return "" if options.host == names[0] else str(options.host)


def _check_rate(plan: RunPlan, layout: Layout) -> None:
    """Refuse a rate at which the timeouts of a robot on the wall clock would be wrong."""
    for name, member in layout.members.items() if plan.rate != 1 and not plan.virtual else ():
        if member.actor.on_wall_clock(member.parameters):
            raise UsageError(f"--rate {plan.rate:g}: expected 1: node {name} exchanges messages "
                             "with a robot on the wall clock, and all timeouts would be "
                             f"{1 / plan.rate:.3g} times as long")


def _check_network(options: argparse.Namespace, spec: SystemSpec) -> None:
    """Refuse to open a port to a network without credentials, unless asked."""
    if options.no_keys and (options.keys or not spec.hosts):
        raise UsageError("--no-keys: " + ("contradicts --keys" if options.keys else
                                          f"{spec.name} runs on one machine, and opens no port"))
    if spec.hosts and not (options.keys or options.no_keys or options.virtual):
        raise UsageError(f"{spec.name} runs on {len(spec.hosts)} hosts: expected --keys DIR "
                         "(`rampart keys init` creates it), or --no-keys to give every client on "
                         "the network full control")


def _checked_keys(options: argparse.Namespace, layout: Layout) -> str:
    """Return the folder of keys.

    Raises:
        UsageError: it lacks a key or certificate of this host.
    """
    if options.virtual:
        raise UsageError(f"--keys {options.keys}: not with --virtual, which has no links")
    extra("keys", "cryptography")
    from rampart.actors.access import key_folder  # noqa: PLC0415 of the extra

    folder = Path(options.keys).resolve()
    until = key_folder.check(folder, [*layout.routers, *sorted(
        layout.hosts.may_run(layout.plan.host, layout.members))])
    left = until - dt.datetime.now(dt.UTC)
    if left < SOON:
        warn(f"--keys {options.keys}: the first certificate expires at {until:%Y-%m-%d %H:%M} UTC; "
             "its owner is then disconnected; `rampart keys rotate` renews certificates")
    return str(folder)


def refuse(options: argparse.Namespace, names: Sequence[str], why: str) -> None:
    """Refuse options that would have no effect."""
    for name in names:
        value = getattr(options, name)
        if value == parser().get_default(name):
            continue
        shown = value[0] if isinstance(value, list) else value
        text = "" if value is True else f" {shown:g}" if isinstance(shown, float) else f" {shown}"
        raise UsageError(f"--{name.replace('_', '-')}{text}: {why}")


def _check(options: argparse.Namespace) -> None:
    between("--rate", options.rate, LEAST_RATE, MOST_RATE)
    positive("--duration", options.duration, below=1e9)
    positive("--patience", options.patience)
    if options.record:
        check_target(Path(options.record), overwrite=options.overwrite)
    elif options.overwrite:
        raise UsageError("--overwrite: only with --record FILE")
    for name, port in (("--port", options.port), ("--hmi-port", options.hmi_port)):
        between(name, port, 1024, LAST_PORT,
                ", below the ports that the kernel gives to outgoing connections")
    if options.black_box and options.virtual:
        raise UsageError("--black-box: not with --virtual: the same --seed gives the same run")
    if options.network != "measured" and not options.virtual:
        raise UsageError(f"--network {options.network}: only with --virtual; Zenoh carries the "
                         "messages of real processes")
    if options.virtual and options.network not in NETWORKS:
        raise UsageError(f"--network {options.network}: unknown; known: {', '.join(NETWORKS)}")
    if options.watchdog and options.virtual:
        raise UsageError(f"--watchdog {options.watchdog}: not with --virtual, which runs ahead of "
                         "real time")
    for role, name in (("--strategy", options.strategy), ("--shadow", options.shadow)):
        if name and name not in STRATEGIES:
            raise UsageError(f"{role} {name}: unknown strategy; known: {', '.join(STRATEGIES)}")


# -- the operator's page ------------------------------------------------------------------------
# Checked before a process starts: a page that cannot be served, or that would be open to
# strangers, is refused in one line.


def own_token(options: argparse.Namespace) -> str:
    """Return the token of the environment, and remove it there: no child process inherits it.

    Raises:
        UsageError: there is a token on the command line.
    """
    own = os.environ.pop(TOKEN_VARIABLE, "")
    if options.hmi_token is not None:
        raise UsageError("--hmi-token: every user of this machine can read a command line; put "
                         "another token into a file of mode 0600 for --hmi-token-file FILE, or "
                         f"into the variable {TOKEN_VARIABLE}")
    return own


def page_of(options: argparse.Namespace, own: str, note: Callable[[str], None]
            ) -> PagePlan:
    """Return address, tokens and encryption of the page.

    Tokens come from a file or the environment, because other users can read a command line. If a
    token is required and none is given, a random one is made.

    Args:
        options: options of the command line.
        own: token of the environment, "" without one.
        note: called with each warning.

    Raises:
        UsageError: options contradict each other, or the page cannot be served.
    """
    if options.no_hmi or options.virtual:
        if options.wait:
            raise UsageError("--wait: the operator's page starts the mission; not with "
                             f"--{'no-hmi' if options.no_hmi else 'virtual'}")
        return PagePlan(0 if options.no_hmi else options.hmi_port)
    host: str = options.hmi_host
    token, listed = _tokens(options, own)
    is_new = not (token or listed or (is_loopback(host) and not options.hmi_behind))
    if is_new:
        token = new_token()
    certificate = _certificate(options, note)
    try:
        Access(host, options.hmi_port, bool(token or listed), certificate is not None,
               options.hmi_unencrypted, behind=options.hmi_behind)
    except AccessError as error:
        which = f"--hmi-behind {options.hmi_behind}" if options.hmi_behind else f"--hmi-host {host}"
        raise UsageError(f"{which}: {error}") from None
    try:
        listen(host, options.hmi_port).close()
    except PortError as error:
        which = f"--hmi-port {options.hmi_port}" if error.is_taken else (
            f"--hmi-host {host}: expected an address of this machine, or 0.0.0.0 for all")
        raise UsageError(f"{which}: {error}") from None
    import rampart.actors.operator.server  # noqa: F401, PLC0415 before the fork, if there is a page

    return PagePlan(
        options.hmi_port, host, token, is_new, listed,
        cert=str(Path(options.hmi_cert).resolve()) if certificate else "",
        key=str(Path(options.hmi_key).resolve()) if certificate else "",
        unencrypted=options.hmi_unencrypted, secret=secrets.token_hex(32),
        shown=_shown(host, certificate), behind=options.hmi_behind)


def audited(page: PagePlan, file: Path) -> PagePlan:
    """Return the plan of the page with a file for its audit log, if there is a page."""
    return msgspec.structs.replace(page, audit_log=str(file)) if page.port else page


def _tokens(options: argparse.Namespace, own: str) -> tuple[str, str]:
    """Return the common token, or the path of a list of personal tokens."""
    source = TOKEN_VARIABLE
    try:
        if options.hmi_token_file:
            source = f"--hmi-token-file {options.hmi_token_file}"
            file = Path(options.hmi_token_file)
            if lists_visitors(file):
                if not read_visitors(file):
                    raise VisitorError("is empty; rampart tokens issue NAME --role ROLE --file "
                                       f"{file}")
                return "", str(file.resolve())
            own = read_secret(file)
        return (check_token(own) if own else ""), ""
    except (AccessError, SecretError, VisitorError) as error:
        raise UsageError(f"{source}: {error}") from None


def _certificate(options: argparse.Namespace, note: Callable[[str], None]
                 ) -> Certificate | None:
    """Return the certificate that is given, if any."""
    cert, key = options.hmi_cert, options.hmi_key
    if not (cert or key):
        return None
    if not cert:
        raise UsageError(f"--hmi-key {key}: expected --hmi-cert FILE, too")
    if not key and Path(cert).is_file() and not holds_key(Path(cert)):
        raise UsageError(f"--hmi-cert {cert}: contains no key; expected --hmi-key FILE, too")
    key = options.hmi_key = key or cert
    if options.hmi_unencrypted:
        raise UsageError(f"--hmi-unencrypted: contradicts --hmi-cert {cert}; expected one of them")
    try:
        _, found = load(Path(cert), Path(key))
    except TlsError as error:
        raise UsageError(f"--hmi-cert, --hmi-key: {error}") from None
    host = options.hmi_host
    if not found.names:
        note(f"--hmi-cert {cert}: contains no name or address (subjectAltName); browsers will "
             "refuse it")
    elif host not in ANY and not found.covers(host):
        note(f"--hmi-cert {cert}: is for {', '.join(found.names)}, not for {host}: browsers that "
             f"open the page at {host} will refuse it")
    if (days := days_left(found)) < _SOON_DAYS:
        note(f"--hmi-cert {cert}: expires in {days:.1f} days; the page will use a new file without "
             "a restart")
    return found


def _shown(host: str, certificate: Certificate | None) -> str:
    """Return the host of the printed address, if possible one that browsers accept."""
    names = certificate.plain_names if certificate else ()
    if host in ANY:
        others = (name for name in names if not is_loopback(name))
        return next(others, next(iter(names), socket.gethostname() if certificate else ""))
    return host
