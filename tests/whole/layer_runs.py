"""Whole missions in virtual time with only some layers of guards on.

`python -m tests.whole.layer_runs N` makes N of each kind at random moments and prints the table of
docs/evidence/results.md.
"""

from __future__ import annotations

import random
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from rampart.sim.campaign.job import Job, run_job
from rampart.sim.faults.scenario import parse_fault
from tests import ROOT

LAYERS = ("dead_man", "safety_pilot_checks", "manager_watch", "supervisor_respawn", "ftm",
          "checkpoints")

KINDS: tuple[tuple[str, tuple[str, ...], tuple[str, ...], tuple[str, ...]], ...] = (
    ("dead man", ("dead_man",), (), ("kill:safety_pilot@{t}",)),
    ("dead man", ("dead_man",), (), ("drop:summit_xl/command@{t}+inf",)),
    ("Safety Pilot's checks", ("safety_pilot_checks",), (), ("command-out-of-bounds@{t}+inf",)),
    ("Safety Pilot's checks", ("safety_pilot_checks",), (), ("command-not-updated@{t}+inf",)),
    ("watch on the manager", ("ftm", "manager_watch"), ("ftm",),
     ("kill:ftm_manager@{before}", "command-not-updated@{t}+inf")),
    ("FTM Manager", ("ftm",), (), ("command-out-of-bounds@{t}+inf",)),
    ("FTM Manager", ("ftm",), (), ("command-not-updated@{t}+inf",)),
    ("supervisor", ("supervisor_respawn",), (),
     ("kill:safety_pilot@{t}", "kill:mission_manager@{after}")),
)
"""Layer, what is on with it, what without it, and what goes wrong."""


def with_layers(directory: Path, system: str, layers: tuple[str, ...]) -> Path:
    """Write a shipped system with only these layers on."""
    text = (ROOT / "systems" / f"{system}.toml").read_text(encoding="utf-8")
    for layer in LAYERS:
        text, found = re.subn(rf"(?m)^{layer} = (true|false)",
                              f"{layer} = {str(layer in layers).lower()}", text)
        assert found == 1, layer
    file = directory / f"{system}-{'-'.join(layers)}.toml"
    file.write_text(text, encoding="utf-8")
    return file


def layered_job(directory: Path, system: str, layers: tuple[str, ...], *faults: str,
                seed: int = 1) -> Job:
    """Return a run of mission A that ends soon after the robot has come to stand."""
    return Job(row="x", system=str(with_layers(directory, system, layers)),
               options={"mission": "A"}, patience_s=10.0, seed=seed,
               faults=tuple(map(parse_fault, faults)))


def main(count: int) -> None:
    print("| layer | fault, permanent | with it alone: safe | without: safe |")
    print("|---|---|---|---|")
    with TemporaryDirectory() as directory:
        for name, layers, without, faults in KINDS:
            dice, safe = random.Random(1), {layers: 0, without: 0}
            for seed in range(1, count + 1):
                t = dice.uniform(5.0, 35.0)
                planned = [f.format(t=f"{t:.2f}", before=f"{t - 2:.2f}", after=f"{t + 10:.2f}")
                           for f in faults]
                for on in safe:
                    result = run_job(layered_job(Path(directory), "paper", on, *planned, seed=seed))
                    assert result.failures == (), result.failures
                    safe[on] += result.safe
            what = " then ".join(f"`{f.partition('@')[0]}`" for f in faults)
            print(f"| {name} | {what} | {safe[layers]} of {count} | {safe[without]} of {count} |",
                  flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
