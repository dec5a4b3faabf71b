"""`rampart check`: is a system one that can be started?"""

from __future__ import annotations

import argparse
from typing import Any

from rampart.cli import systems
from rampart.cli.output import UsageError, print_json, say
from rampart.cli.verbs import JSON, add_verb


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "check", "is a system sound? All that is known without running it", run,
             systems.choice(), JSON)


def run(options: argparse.Namespace) -> int:
    """Check a system, and say what is wrong with it, or how large it is.

    Check all of a system that can be checked before it runs, as a start does: the
    specification, the time budget, classes and parameters of all actors, application
    and judge, and that what each node hears is published by somebody.

    Examples:
      rampart check
      rampart check my_system.toml && rampart run --system my_system.toml
      rampart check paper --json

    exit code: 0 sound, 2 not sound (one line says where) or bad usage
    """
    try:
        layout = systems.check(options.system)
    except UsageError as error:
        if not options.json:
            raise
        print_json({"sound": False, "problem": str(error)})
        return 2
    spec = layout.spec
    sizes = {"processes": len(layout.units), "nodes": len(spec.nodes),
             "detection modules": len(spec.detections), "recovery modules": len(spec.recoveries),
             "mechanisms": len(spec.mechanisms)}
    if options.json:
        print_json({"sound": True, "problem": None, "system": spec.name,
                    "file": layout.plan.system_file,
                    **{name.replace(" ", "_"): count for name, count in sizes.items()}})
    else:
        say(f"{layout.plan.system_file}: sound: "
            f"{', '.join(f'{count} {name}' for name, count in sizes.items())}")
    return 0
