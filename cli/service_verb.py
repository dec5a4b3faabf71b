"""`rampart service`: a unit file of systemd for a system."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from rampart import systems
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.cli.output import UsageError, refusing, say_text
from rampart.cli.verbs import add_verb, option, word

_UNIT = """\
# {file} as a service, made by `rampart service`. Install it with:
#   rampart service ... | sudo tee /etc/systemd/system/{name}.service
#   sudo systemctl daemon-reload && sudo systemctl enable --now {name}
[Unit]
Description=Rampart: {title}
StartLimitIntervalSec=60
StartLimitBurst=5

[Service]
Type=notify
User={user}
ExecStart={command}
# Reports and checkpoints lie in the state directory, the run's sockets in the other one.
StateDirectory={name}
WorkingDirectory=%S/{name}
RuntimeDirectory={name}
RuntimeDirectoryMode=0700
Environment=XDG_RUNTIME_DIR=%t/{name}
# systemd ends and restarts the service if root, supervisor or manager stays away for so long.
WatchdogSec={watchdog_s:g}
TimeoutStartSec=30
TimeoutStopSec=10
# Only the root gets SIGTERM: it ends the nodes in order. A mission that failed is not repeated.
KillMode=mixed
Restart=on-abnormal
RestartForceExitStatus=4
RestartSec=1

[Install]
WantedBy=multi-user.target
"""


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

    with refusing(ValueError):
        chosen = shlex.split(options.options)
    run_options.parse(["--system", str(file), *chosen], "rampart run")
    words = [str(Path(sys.executable).with_name("rampart")), "run", "--system",
             str(file.resolve()), *chosen]
    say_text(_UNIT.format(
        file=file.name, name=f"rampart-{spec.name}", title=" ".join(spec.title.split()),
        user=options.user, watchdog_s=options.watchdog_s,
        command=" ".join(map(_quoted, words))))
    return 0


def _quoted(text: str) -> str:
    """Return a word of systemd.service(5): specifiers and variables are escaped."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if set(escaped) & set(" \t'\"\\;") else escaped
