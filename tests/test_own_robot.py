"""A robot of one's own: what `launch.py` says of its modules, and of what it has not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from stub_actors import ROOT

PAPER = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
WORLD = ('[[node]]\nname = "simulator"\nactor = "sim.simulator:Simulator"\nkind = "world"\n'
         'respawn = "supervisor"\n')


def changed(text: str, *changes: tuple[str, str]) -> str:
    """Return a spec with some text replaced, each of which has to be there once."""
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def launched(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `launch.py` in a directory, and find nothing there but what it brings."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), *arguments], cwd=directory, env=environment,
        capture_output=True, text=True, check=False, timeout=120)


def test_without_ground_truth_safety_is_not_known_in_console_json_page_and_exit_code(tmp_path):
    (tmp_path / "blind.toml").write_text(changed(PAPER, (WORLD, "")))
    done = launched(tmp_path, "--system", "blind.toml", "--virtual", "--patience", "3", "--json",
                    "--report", str(tmp_path / "report"))
    assert done.returncode == 4, done.stderr
    assert "fail, not known" in done.stderr
    assert "safe by" not in done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert (result["mission"], result["safety"]) == ("fail", "not known")
    assert any("no ground truth ever came" in reason for reason in result["reasons"])
    assert json.loads(Path(result["record"]).read_text())["safety"] == "not known"
    page = Path(result["report"]).read_text()
    assert '<div class="verdict unknown">Safety<b>not known</b></div>' in page
    assert "stayed safe" not in page
    assert "4 safety not known" in launched(tmp_path, "--help").stdout
