"""`rampart campaign --search`: the optimiser's hunt for the smallest safety margin."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import joblib
import msgspec
from tqdm import tqdm

from rampart.cli.output import UsageError, print_json, print_table, refusing, say, say_text, warn
from rampart.sim.campaign.job import Job, RunResult, run_job, trial_of_system
from rampart.sim.campaign.search import Space, margin, search, shrink
from rampart.sim.campaign.store import Store, StoreError
from rampart.sim.faults.faults import Faults

_SHRUNK_AT_MOST = 3


def hunt(options: argparse.Namespace, groups: dict[str, tuple[str, ...]], bases: Sequence[Job],
         faults: Faults, moments: tuple[float, float]) -> int:
    """Search among the faults in `groups`, shrink what was found, and keep it."""
    directory = Path(options.out or "reports/campaign-search")
    with refusing(StoreError):
        store = Store(directory)
    unit = trial_of_system(options.system).margin_unit
    workers = options.jobs or os.cpu_count() or 1
    with joblib.Parallel(n_jobs=workers, batch_size=1) as pool, tqdm(
            total=options.search, unit="run", file=sys.stderr,
            disable=None) as bar:  # no bar into a file

        def run(jobs: Sequence[Job]) -> Sequence[RunResult]:
            return list(pool(joblib.delayed(run_job)(job) for job in jobs))

        smallest = math.inf

        def seen(job: Job, result: RunResult) -> None:
            nonlocal smallest
            try:
                store.add(job, result)
            except StoreError as error:
                raise UsageError(f"{error}; what was finished is in {directory}") from None
            if margin(result) < smallest:
                smallest = margin(result)
                bar.write(f"{smallest:8.3f} {unit}  {job.key}  {job.text()}", file=sys.stderr)
            bar.update()

        try:
            space = Space(tuple(bases), groups, faults.intruder, moments)
            made = search(space, options.search, run, seed=options.seed, at_once=workers, seen=seen)
        except ImportError:
            raise UsageError("--search: Optuna is not installed; pip install 'rampart[search]'"
                             ) from None
    unsafe = [job for job, result in made if not result.safe]
    store.close()
    shrunk = [_shrunk(job, directory) for job in unsafe[:_SHRUNK_AT_MOST]]
    if options.json:
        print_json({"runs": len(made), "unsafe": len(unsafe), f"smallest_margin_{unit}": smallest,
                    "counterexamples": [{"file": str(path) if path else None, "job": job}
                                        for job, path in shrunk]})
    else:
        print_table(("margin", "run", "faults"), [
            (f"{margin(result):.3f} {unit}", job.key, job.text()) for job, result in made[:10]])
        say_text(f"\n{len(made)} runs, {len(unsafe)} unsafe, smallest margin {smallest:.3f} {unit}")
        for job, path in shrunk:
            chosen = "".join(f"{name} {value}, " for name, value in job.options.items())
            say(f"counterexample: {job.text()}, {chosen}seed {job.seed}: {path or 'not written'}")
    return 1 if unsafe else 0


def _shrunk(job: Job, directory: Path) -> tuple[Job, Path | None]:
    """Return what is left of a job, and its file; None if that cannot be written."""
    small = shrink(job, tried=lambda tried, found: print(
        f"shrinking {'to' if found else 'not to'} {tried.text()}", file=sys.stderr))
    path = directory / "counterexamples" / f"{small.key}.toml"
    try:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(msgspec.toml.encode(small))
    except OSError as error:
        warn(f"{path}: {error.strerror}")
        return small, None
    return small, path
