"""`rampart service`: a unit file of systemd for a system."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from rampart import systems
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.cli.output import UsageError, rendered, say_text
from rampart.cli.verbs import add_verb, option, word


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "service", "print a systemd unit for a system", service,
             option("system", metavar="SYSTEM", help="system file, or name of a shipped system"),
             word("--user", "NAME", "user of the service (default: rampart)", "rampart"),
             option("--watchdog-s", type=float, default=3.0, metavar="S",
                    help="seconds after which systemd restarts a service that hangs (default: 3)"),
             word("--options", "TEXT", "options of `rampart run`, as one word", ""))


def service(options: argparse.Namespace) -> int:
    """Print the unit.

    Print a unit file with which systemd starts a system at boot, and restarts it if
    its root, its supervisor or its FTM Manager hangs (WATCHDOG=1 of sd_notify).

    Examples:
      rampart service osmosis
      rampart service robot.toml --user robot --options="--no-hmi --watchdog /dev/watchdog"
    """
    file = systems.find(options.system)
    if not file.is_file():
        raise UsageError(f"{options.system}: no such file; expected a system file, or the name of "
                         f"a shipped system: {systems.names()}")
    if not 1 <= options.watchdog_s <= 3600:
        raise UsageError(f"--watchdog-s {options.watchdog_s:g}: expected 1 to 3600")
    spec = load_system(RunPlan(system_file=str(file)))
    from rampart.cli import run_options  # noqa: PLC0415 other verbs need no physics

    chosen = shlex.split(options.options)
    run_options.parse(["--system", str(file), *chosen], "rampart run")
    words = [str(Path(sys.executable).with_name("rampart")), "run", "--system",
             str(file.resolve()), *chosen]
    say_text(rendered(
        Path(__file__).with_name("rampart.service.jinja"), file=file.name,
        name=f"rampart-{spec.name}", title=" ".join(spec.title.split()), user=options.user,
        watchdog_s=options.watchdog_s, command=" ".join(map(_quoted, words))))
    return 0


def _quoted(text: str) -> str:
    """Return a word of systemd.service(5): specifiers and variables are escaped."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if set(escaped) & set(" \t'\"\\;") else escaped
