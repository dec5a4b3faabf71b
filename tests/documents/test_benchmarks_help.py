"""The benchmarks say what they are for, and measure nothing when they are asked."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests import ROOT

MEASURING = [file.stem for file in sorted((ROOT / "benchmarks").glob("*.py"))
             if "__main__" in file.read_text(encoding="utf-8")]


@pytest.mark.parametrize("name", MEASURING)
def test_a_benchmark_has_help(name):
    done = subprocess.run([sys.executable, "-m", f"benchmarks.{name}", "--help"], cwd=ROOT,
                          capture_output=True, text=True, check=False, timeout=20)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: ")
