"""What keys cost: restarts of a whole system and round trips, with and without them, in turn.

The system runs without keys, then with keys that are made for it, and so on, so that a slow moment
of the machine hits both. Needs `cryptography`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rampart.actors.access import key_folder
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.cli.bench.figures import Floor, Kill, ratio, spread
from rampart.cli.bench.floors import trips_of_actors
from rampart.cli.bench.killing import Show
from rampart.cli.bench.programs import BenchError
from rampart.cli.bench.restart import measure_restart
from rampart.cli.bench.systems import talking_system

TARGET = 1.5
"""At most so many times as long with keys."""

_ROUNDS = 3


def made_keys(file: Path, folder: Path) -> str:
    """Return a folder of keys for all processes of a system, and for an operator.

    Args:
        file: the system.
        folder: in which it is made.
    """
    plan = RunPlan(system_file=str(file))
    layout = Layout(plan, load_system(plan))
    keys = folder / f"keys-{file.stem}"
    if not keys.exists():
        key_folder.init(keys)
        key_folder.issue(keys, tuple(layout.routers), "router")
        key_folder.issue(keys, tuple(layout.members), "node")
        key_folder.issue(keys, ("benchmark",), "operator")
    return str(keys)


def measure_keys(file: Path, names: Sequence[str], kills: int, folder: Path,
                 show: Show) -> tuple[Floor, ...]:
    """Compare restarts of each node, of all together, and round trips.

    Args:
        file: The system.
        names: Of nodes and modules.
        kills: Of each, with keys and without.
        folder: For keys and checkpoints.
        show: Shows what is being done.

    Raises:
        BenchError: The system cannot be started.
    """
    talk = folder / "talk.toml"
    talk.write_text(talking_system(), encoding="utf-8")
    rounds = min(_ROUNDS, kills)
    taken: dict[str, dict[bool, list[Kill]]] = {n: {False: [], True: []} for n in names}
    trips: dict[bool, list[float]] = {False: [], True: []}
    notes: dict[str, str] = {}
    for number in range(rounds):
        for keyed in (False, True):
            begun = kills * number // rounds
            place = folder / f"{number}{'with' if keyed else 'without'}"
            place.mkdir()
            for found in measure_restart(
                    file, names, kills * (number + 1) // rounds - begun, place, show,
                    keys=made_keys(file, folder) if keyed else ""):
                taken[found.name][keyed] += found.kills
                notes[found.name] = notes.get(found.name) or found.note
            try:
                show(f"round trips, {number + 1} of {rounds}")
                trips[keyed] += trips_of_actors(
                    talk, place, made_keys(talk, folder) if keyed else "")
            except BenchError as error:
                notes["trip"] = str(error)

    def row(name: str, title: str, samples: dict[bool, list[float | None]]) -> Floor:
        without, with_keys = spread(samples[False]), spread(samples[True])
        return Floor(name, title, "ms", without, "with keys", with_keys,
                     ratio(with_keys, without), TARGET, notes.get(name, ""))

    outputs: dict[str, dict[bool, list[float | None]]] = {
        name: {keyed: [kill.output for kill in those] for keyed, those in of.items()}
        for name, of in taken.items()}
    rows = [row(name, f"{name}, killed, to its replacement's first output", of)
            for name, of in outputs.items()]
    if len(rows) > 1:
        rows.append(row("all", "all of these", {keyed: [
            sample for of in outputs.values() for sample in of[keyed]]
            for keyed in (False, True)}))
    return (*rows, row("trip", "round trip of two actors", {
        keyed: [1e3 * one for one in those] for keyed, those in trips.items()}))
