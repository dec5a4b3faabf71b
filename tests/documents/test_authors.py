"""docs/tutorials/your-own-robot.md: followed to the letter, block by block."""

from __future__ import annotations

import re
from pathlib import Path

from tests.documents.page import Page, succeed

BLOCKS = Page("tutorials/your-own-robot").blocks


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
    where, said = tmp_path, []
    for language, block in BLOCKS:
        if language != "sh":
            first, _, rest = block.partition("\n")
            follow(tmp_path / "courier", first, rest)
            continue
        for line in block.splitlines():
            if line.startswith("cd "):
                where = where / line.removeprefix("cd ")
            else:
                said.append(succeed(line, where))
    assert len(BLOCKS) > 10
    assert "18 passed, 1 deselected" in said[2]
    assert '"mission": "success"' in said[1]
    assert '"mission": "success"' in said[-2]
    assert "10 of them made now" in said[-1]
