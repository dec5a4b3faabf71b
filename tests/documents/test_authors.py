"""docs/tutorials/your-own-robot.md: followed to the letter, block by block."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

from tests import ROOT

DOCUMENT = (ROOT / "docs/tutorials/your-own-robot.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", DOCUMENT, re.DOTALL | re.MULTILINE)


def follow(robot: Path, first: str, rest: str) -> None:
    """Do with a block of code what its first line says."""
    name, _, what = first.removeprefix("# ").partition(", ")
    file = robot.parent / robot.name / name
    if what == "as it was made":
        assert rest in file.read_text(encoding="utf-8"), name
    elif what == "added":
        file.write_text(file.read_text(encoding="utf-8") + "\n" + rest, encoding="utf-8")
    elif what:
        before, table, _ = file.read_text(encoding="utf-8").partition(
            what.removeprefix("in place of "))
        after = re.sub(r"\A.*?(?=^\[\[|\Z)", "", _, flags=re.DOTALL | re.MULTILINE)
        assert table, what
        file.write_text(before + rest + "\n" + after, encoding="utf-8")
    else:
        assert not file.exists(), name
        file.write_text(rest, encoding="utf-8")


def test_the_guide_leads_where_it_says(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore",
                   "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    where, said = tmp_path, []
    for language, block in BLOCKS:
        if language != "sh":
            first, _, rest = block.partition("\n")
            follow(tmp_path / "courier", first, rest)
            continue
        for line in block.splitlines():
            command = shlex.split(line)
            if command[0] == "cd":
                where = where / command[1]
                continue
            done = subprocess.run(command, cwd=where, env=environment, text=True,
                                  capture_output=True, check=False)
            assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
            said.append(done.stdout)
    assert len(BLOCKS) > 10
    assert "18 passed, 1 deselected" in said[2]
    assert '"mission": "success"' in said[1]
    assert '"mission": "success"' in said[-2]
    assert "10 of them made now" in said[-1]
