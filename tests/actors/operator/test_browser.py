"""Without a browser the page is not tested: that is said, or is a failure where it has to be."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests import ROOT


@pytest.mark.parametrize(("asked", "workers", "code", "outcome"), [
    ("", "1", 0, "skipped"), ("1", "0", 1, "error")])
def test_without_chromium_the_last_line_says_so_or_the_tests_fail(
        tmp_path, asked, workers, code, outcome):
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "page", "-n", workers,
         "tests/actors/operator/test_camera.py"], cwd=ROOT, text=True, capture_output=True,
        env={**os.environ, "PATH": str(tmp_path), "RAMPART_TEST_PAGE": asked}, check=False)
    assert done.returncode == code, done.stdout
    lines = done.stdout.splitlines()
    counts = lines[-1 if asked else -2]
    assert outcome in counts
    assert "passed" not in counts
    assert "no Chromium: `apt-get install chromium` brings it" in done.stdout
    assert [line for line in lines if line.startswith("not tested: the operator's page")] == (
        [] if asked else lines[-1:])
