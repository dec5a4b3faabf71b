"""Every unsafe run that was ever found, and shrunk, is run again: none of them may be unsafe."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from sim.campaign.job import Job, run_job

FILES = sorted((Path(__file__).parent / "counterexamples").glob("*.toml"))


def test_there_are_some():
    assert FILES


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_what_was_unsafe_once_is_safe_now(file):
    job = msgspec.toml.decode(file.read_bytes(), type=Job)
    result = run_job(job)
    assert result.effective, [outcome.reason for outcome in result.outcomes]
    assert result.safe, result.reasons
    assert result.failures == ()
