"""Every unsafe run that was ever found, and shrunk, is run again: none of them may be unsafe.

Each is run on the system that it was found on, which its file names, and on the full one. Those of
the paper's system run in the night: the full system's laser checks have tests of their own.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from rampart.sim.campaign.job import Job, run_job

FOUND = {file.stem: msgspec.toml.decode(file.read_bytes(), type=Job)
         for file in sorted((Path(__file__).parent / "counterexamples").glob("*.toml"))}


def test_there_are_some():
    assert FOUND


@pytest.mark.parametrize(("name", "system"), [
    pytest.param(name, system, marks=[pytest.mark.nightly] * (job.system != "osmosis"))
    for name, job in FOUND.items() for system in sorted({job.system, "osmosis"})])
def test_what_was_unsafe_once_is_safe_now(name, system):
    result = run_job(msgspec.structs.replace(FOUND[name], system=system))
    assert result.effective, [outcome.reason for outcome in result.outcomes]
    assert result.safe, result.reasons
    assert result.failures == ()
