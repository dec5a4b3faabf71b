"""What can be said on the command line when a system is started, and the plan that follows.

Start a system from its spec, run it, judge it, report on it.

Examples:
while it runs, from another shell:
  kill-node NODE                                    kill a node and watch it come back
  rampart inject --list                             the faults that can be injected
  rampart status                                    what the robot and its nodes are doing
exit code: 0 success and safe, 1 mission failed but safe, or a node was given up or kept failing,
2 bad usage or spec, 3 unsafe, 4 safety not known: no ground truth ever came. A report that cannot
be written and output that nobody reads change none of them; with --json, "report_error" says why
there is no "report"
"""

from __future__ import annotations

import argparse
import os
import socket
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from rampart import systems
from rampart.actors.layout.layout import Layout, application_class
from rampart.actors.layout.wiring import load_class
from rampart.actors.recording.bag_writer import check_target
from rampart.actors.run.application import Application
from rampart.actors.run.run_plan import DEFAULT_PORT, RunPlan, load_system
from rampart.actors.web.access import Access, AccessError, is_loopback, new_token
from rampart.actors.web.token_file import SecretError, read_secret
from rampart.cli import application_options
from rampart.cli.output import UsageError, between, positive
from rampart.cli.verbs import (
    PORT_VARIABLE,
    add_options,
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
from rampart.sim.runs.rate_search import LEAST, MOST
from rampart.sim.virtual.network import NETWORKS

ERROR_LOG = "errors.log"
LAST_PORT = 32_000
TOKEN_VARIABLE = "RAMPART_HMI_TOKEN"  # noqa: S105 the name of one
HMI = "rampart.actors.operator.hmi:Hmi"

MAX_RATE = "max"


def _rate(text: str) -> float | str:
    try:
        return MAX_RATE if text == MAX_RATE else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}: a number from {LEAST:g} to {MOST:g} is right, or {MAX_RATE}") from None


_EXAMPLES = (
    ("", "the shipped system, as its spec says"),
    ("--rate 4 --no-hmi --json", "four times real time, result as JSON"),
    ("--hmi-host 0.0.0.0", "the page for other machines too, with a token"),
    ("--hmi-token-file FILE", "the page for others, with a token of yours"),
    ("--record run.mcap", "keep everything that is said; `rampart replay`"),
    ("--no-ftm", "the baseline, without fault tolerance"),
    ("--virtual --seed 7", "in seconds, and every time the same"),
    ("--virtual --fault kill:NODE@30 --fault drop:TOPIC@goal2+5", "with faults"),
    *((f"--system {name}", "another one that is shipped") for name in systems.names().split(", ")),
)

_OPTIONS = (
    flag("--wait", "let the operator start the mission from the page"),
    word("--system", "FILE", f"system spec, or name of a shipped one: {systems.names()} (default: "
         "osmosis)", str(systems.DEFAULT)),
    word("--strategy", "NAME", f"one of {', '.join(STRATEGIES)} (default: the system's)", ""),
    word("--shadow", "NAME", "a second strategy that decides without effect; where it differs, it "
         "says so (default: the system's)", ""),
    flag("--no-ftm", "run the paper's unprotected baseline: last command kept, no dead man, no "
         "respawn"),
    option("--rate", type=_rate, metavar="R", default=1.0, help="simulated seconds per second, or "
           f"{MAX_RATE}: as many as this machine keeps up with, which short runs find out before "
           "(default: 1)"),
    whole("--seed", "N", "for sensor noise (default: 1)", 1),
    flag("--no-hmi", "no operator's page (its node still runs)"),
    whole("--hmi-port", "PORT", "port of the operator's page (default: 8080)", 8080),
    word("--hmi-host", "HOST", "address of the operator's page (default: 127.0.0.1, this machine "
         "only). Any other makes it need a token, which is printed with the page's address when "
         "the run starts", "127.0.0.1"),
    word("--hmi-token-file", "FILE", "a file of yours, of mode 0600, with that token, 16 "
         f"characters or more, to keep it over several runs; or set {TOKEN_VARIABLE} to it "
         "(default: a random one; for yourself on this machine none is needed)", ""),
    option("--hmi-token", nargs="?", const="", help=argparse.SUPPRESS),  # refused
    port_option("--port", "number that tells runs on this machine apart; no port is opened "
                f"(default: that of {PORT_VARIABLE}, else {DEFAULT_PORT})", DEFAULT_PORT,
                metavar="PORT"),
    number("--patience", "S", "simulated seconds without progress after which the mission counts "
           "as failed (default: 60)", 60.0),
    number("--duration", "S", "simulated seconds after which a system without a mission ends "
           "(default: when it is interrupted)"),
    word("--record", "FILE", "keep everything that is sent in an MCAP file, for `rampart bag "
         "info`, `rampart replay` and Foxglove-compatible viewers"),
    flag("--overwrite", "--record may replace an existing file"),
    word("--report", "DIR", f"where the report goes, checkpoints, and in {ERROR_LOG} the "
         "tracebacks of nodes that failed (default: reports/TIME-MISSION, without a mission "
         "reports/TIME-SYSTEM)"),
    flag("--virtual", "run a mission in virtual time: all actors in this process, many times "
         "faster than real; the same --seed gives the same run, to the byte"),
    word("--network", "NAME", "with --virtual, what lies between the nodes: "
         f"{', '.join(NETWORKS)} (default: measured)", "measured"),
    several("--fault", "FAULT[@WHEN][+S]", "a fault to inject into a mission (repeatable): one of "
            "`rampart inject --list`, MODE:TOPIC, kill:NODE, stop:NODE, wedge:NODE, slow:NODE, "
            "slow:all, or of the robot's; WHEN is simulated seconds or goalN (default: 10), S how "
            "long it lasts"),
    flag("--json", "last line of stdout is one JSON object with the result"))


def parser(program: str = "", kind: type[Application] = Application,
           said: Mapping[str, Any] | None = None) -> argparse.ArgumentParser:
    """Return the parser of the command line.

    Args:
        program: as it is typed.
        kind: the application of the system that is started, which adds options.
        said: what the system's spec says of them.
    """
    examples = "".join(f"  {program} {how:<40} {what}\n" for how, what in (
        *_EXAMPLES, *kind.examples))
    shown = help_of(__doc__)  # the examples themselves depend on program and system
    shown["epilog"] = shown["epilog"].replace("examples:\n", f"examples:\n{examples}", 1)
    p = argparse.ArgumentParser(prog=program, **shown)
    add_options(p, _OPTIONS)
    application_options.add(p, kind, said or {})
    return p


def parse(arguments: Sequence[str] | None, program: str
          ) -> tuple[argparse.Namespace, type[Application]]:
    """Return the options, those of the system's application included, and its class.

    Args:
        arguments: of the command line; None for those of this process.
        program: as it is typed.

    Raises:
        UsageError: there is no such system, or an option that it does not have.
        ValueError: the system's spec is unsound.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--system", default=str(systems.DEFAULT))
    system = str(first.parse_known_args(arguments)[0].system)
    spec = load_system(RunPlan(system_file=str(_system_file(system))))
    kind = application_class(spec)
    options, unknown = parser(program, kind, spec.application).parse_known_args(arguments)
    if unknown:
        raise UsageError(f"{unknown[0]}: no option of the launcher or of {spec.name}; --system "
                         f"{system} --help shows those there are")
    return options, kind


def _system_file(system: str) -> Path:
    found = systems.find(system)
    if not found.is_file():
        what = "is a directory" if found.is_dir() else "no such file"
        raise UsageError(f"--system {system}: {what}; a spec is right, or the name of a "
                         f"shipped one: {systems.names()}")
    working_folder.admit(found.parent)
    return found


def plan_of(options: argparse.Namespace, kind: type[Application]) -> tuple[RunPlan, SystemSpec]:
    """Return the plan that the options ask for, and the system they name.

    Raises:
        UsageError: an option makes no sense, or not in this system.
        ValueError: the system's spec is unsound.
    """
    _check(options)
    system_file = _system_file(options.system)
    token, token_is_new = _token(options)
    plan = RunPlan(
        run_id=uuid.uuid4().hex[:12], base_port=options.port,
        rate=1.0 if options.rate == MAX_RATE else options.rate,
        seed=options.seed, system_file=str(system_file.resolve()), strategy=options.strategy,
        ftm=not options.no_ftm, options=application_options.chosen(options, kind),
        hmi_port=0 if options.no_hmi else options.hmi_port, shadow=options.shadow,
        hmi_host=options.hmi_host, hmi_token=token, hmi_token_is_new=token_is_new,
        waits=options.wait, virtual=options.virtual)
    spec = load_system(plan)
    layout = Layout(plan, spec)
    if not options.no_hmi:
        plan = msgspec.structs.replace(plan, faults=faults_of(spec).offered())
    if not any(issubclass(member.actor, load_class(HMI)) for member in layout.members.values()):
        refuse(options, ("wait", "hmi_port", "hmi_host", "hmi_token_file"),
               f"no node of {spec.name} serves an operator's page")
        plan = msgspec.structs.replace(plan, hmi_port=0)
    return plan, spec


def refuse(options: argparse.Namespace, names: Sequence[str], why: str) -> None:
    """Refuse options that would have no effect, each by its name and value as it is typed."""
    for name in names:
        value = getattr(options, name)
        if value == parser().get_default(name):
            continue
        shown = value[0] if isinstance(value, list) else value
        text = "" if value is True else f" {shown:g}" if isinstance(shown, float) else f" {shown}"
        raise UsageError(f"--{name.replace('_', '-')}{text}: {why}")


def _check(options: argparse.Namespace) -> None:
    if options.rate != MAX_RATE:
        between("--rate", options.rate, LEAST, MOST)
    elif options.virtual:
        raise UsageError(f"--rate {MAX_RATE}: only on real processes; virtual time has no rate, it "
                         "is always as fast as it can be")
    positive("--duration", options.duration, below=1e9)
    positive("--patience", options.patience)
    if options.record:
        check_target(Path(options.record), overwrite=options.overwrite)
    elif options.overwrite:
        raise UsageError("--overwrite: only with --record FILE")
    for name, port in (("--port", options.port), ("--hmi-port", options.hmi_port)):
        between(name, port, 1024, LAST_PORT,
                ", below the ports that the kernel gives to outgoing connections")
    if options.network != "measured" and not options.virtual:
        raise UsageError(f"--network {options.network}: only with --virtual; Zenoh carries the "
                         "messages of real processes")
    if options.virtual and options.network not in NETWORKS:
        raise UsageError(f"--network {options.network}: unknown; known: {', '.join(NETWORKS)}")
    for role, name in (("--strategy", options.strategy), ("--shadow", options.shadow)):
        if name and name not in STRATEGIES:
            raise UsageError(f"{role} {name}: unknown strategy; known: {', '.join(STRATEGIES)}")


def _token(options: argparse.Namespace) -> tuple[str, bool]:
    """Return what the operator's page asks for, and whether it is new and has to be printed.

    It comes from a file or the environment, which other users cannot read as they can read a
    command line; where none is given and one is needed it is made.
    """
    host: str = options.hmi_host
    own = os.environ.pop(TOKEN_VARIABLE, "")  # not for whatever is started
    if options.hmi_token is not None:
        raise UsageError("--hmi-token: a command line is read by every user of this machine; put "
                         "another token into a file of mode 0600 for --hmi-token-file FILE, or "
                         f"into the variable {TOKEN_VARIABLE}")
    if options.no_hmi or options.virtual:
        if options.wait:
            raise UsageError("--wait: the mission is started from the operator's page, which there "
                             f"is not with --{'no-hmi' if options.no_hmi else 'virtual'}")
        return "", False
    source = TOKEN_VARIABLE
    try:
        if options.hmi_token_file:
            source = f"--hmi-token-file {options.hmi_token_file}"
            own = read_secret(Path(options.hmi_token_file))
        token = own or ("" if is_loopback(host) else new_token())
        Access(host, options.hmi_port, token)
    except (AccessError, SecretError) as error:
        raise UsageError(f"{source}: {error}") from None
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, number) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise UsageError(f"--hmi-host {host}: no address of this machine ({why}); 0.0.0.0 stands "
                         "for all it has") from None
    return token, bool(token) and not own
