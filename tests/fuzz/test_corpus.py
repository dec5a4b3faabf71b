"""What fuzzing has found once stays mended, and some hundred new inputs are run each time.

The inputs are the same each time: a failure here is found again by running the test again. Time and
memory are bounded in `make fuzz`, where each target has a process of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from random import Random

import pytest

from tests import ROOT
from tests.fuzz import targets
from tests.fuzz.mutate import Mutator
from tests.fuzz.target import MAX_INPUT

ALL = sorted(targets.ALL)
KEPT = [(name, path) for name in ALL for path in sorted(targets.ALL[name].folder.glob("*"))]


@pytest.mark.parametrize(("name", "path"), KEPT, ids=[f"{n}-{p.name}" for n, p in KEPT])
def test_an_input_that_found_something_once_finds_nothing_now(name, path):
    targets.ALL[name].outcome(path.read_bytes())


@pytest.mark.parametrize("name", ALL)
def test_samples_are_read_or_refused_and_so_is_what_is_made_of_them(name):
    one = targets.ALL[name]
    draw, mutated, pool = Random(7), Mutator(one.kind, one.words), [*one.samples(), *one.corpus()]
    outcomes = {one.outcome(data) for data in pool}
    assert "read" in outcomes or one.refuses
    for _ in range(one.suite_runs):
        data = mutated(draw.choice(pool), draw.choice(pool), draw)
        assert len(data) <= MAX_INPUT
        outcome = one.outcome(data)
        if outcome not in outcomes:
            outcomes.add(outcome)
            pool.append(data)


# -- the harness itself ----------------------------------------------------------------------------

SICK = '''
import os, time
from tests.fuzz.target import target

@target("sick", refuses=(ValueError,), samples=lambda: [b"abc"], says_one_line=True)
def sick(data):
    how = os.environ["SICK"]
    if data == b"abc":
        return
    if how == "raises":
        {}[data]
    if how == "says much":
        raise ValueError("two\\nlines")
    if how == "hangs":
        while True:
            pass
    if how == "eats":
        bytearray(1 << 30)
    if how == "dies":
        os.abort()
'''


@pytest.mark.parametrize(("how", "words"), [
    ("raises", "KeyError"), ("says much", "UnsoundError"), ("eats", "MemoryError"),
    pytest.param("hangs", "more than 2 s of processor", marks=pytest.mark.slow),
    ("dies", "death by SIGABRT"), ("well", "")])
def test_what_a_decoder_must_not_do_is_found_and_kept(tmp_path, how, words):
    (tmp_path / "sick_target.py").write_text(SICK)
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.run", "--module", "sick_target", "--target", "sick",
         "--runs", "4", "--engine", "own", "--json", "--keep", str(tmp_path / "kept")],
        capture_output=True, text=True, timeout=110, check=False, env={
            **os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}", "SICK": how})
    assert done.returncode == (1 if words else 0), done.stderr
    (result,) = json.loads(done.stdout)
    assert {words in found["what"] for found in result["findings"]} <= {True}
    assert bool(result["findings"]) == bool(words)
    kept = {path.name for path in (tmp_path / "kept").rglob("sick/*")}
    assert kept == {Path(found["input"]).name for found in result["findings"]}
