"""README, docs and the changelog's newest section: what they name is there.

Files and folders of this repository, links with their anchors, modules and classes, programs that
are run with `-m`, and verbs of `rampart`.
"""

from __future__ import annotations

import argparse
import pkgutil
import re
import subprocess
from pathlib import Path

import pytest

from rampart.cli.main import build_parser
from tests import ROOT

TOPS = "actors|benchmarks|cli|docs|files|manager|rampart|sim|systems|tests"
PAGES = {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8")
         for file in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
         if file.parent.name != "log"}
SECTIONS = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")[1:]
PAGES["CHANGELOG.md"] = next(text for text in SECTIONS if text.count("\n") > 2)
KEYS = set(re.findall(r"^\| `([^`]+)` \|", (ROOT / "topics.md").read_text(encoding="utf-8"),
                      re.MULTILINE))


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def is_there(dotted: str) -> bool:
    try:
        pkgutil.resolve_name(dotted)
    except (ImportError, AttributeError):
        return False
    return True


@pytest.fixture(scope="module")
def verbs() -> set[str]:
    return {verb for action in build_parser()._actions  # argparse has no other way
            if isinstance(action, argparse._SubParsersAction) for verb in action.choices}


@pytest.mark.parametrize("page", PAGES)
def test_files_links_modules_and_verbs_are_there(page, verbs):
    text, here = PAGES[page], ROOT / page
    said = set(re.findall(rf"`((?:{TOPS})/[\w./-]*)`", text)) - KEYS
    assert [path for path in said if not (ROOT / path).exists() and path.lower() == path] == []
    lost = []
    for target, anchor in re.findall(r"\]\((?!http)([^)#\s]*)(?:#([^)]+))?\)", text):
        file = here.parent / target if target else here
        if not file.exists() or (anchor and anchor not in anchors(file)):
            lost.append(f"{target}#{anchor}")
    assert lost == []
    said = set(re.findall(r"\brampart(?:\.[A-Za-z_]\w*)+(?::\w+)?", text))
    # These are no modules but metadata and entry points.
    said -= {"rampart.run", "rampart.end", "rampart.verbs", "rampart.campaigns"}
    assert {name for name in said if not is_there(name)} == set()
    run = re.findall(r"python -m ((?:tests|benchmarks)[.\w]+)", text)
    assert [m for m in run if not (ROOT / m.replace(".", "/")).with_suffix(".py").exists()] == []
    said = set(re.findall(
        r"(?:^|`|\$ |; |bin/)rampart ([a-z][a-z0-9-]*)", text, re.MULTILINE))
    assert said <= verbs


def test_no_text_installs_another_project_s_package():
    """On the package index `rampart` is not this project; ours is `rampart-robot`."""
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True,
                           capture_output=True).stdout.decode().split("\0")
    foreign = re.compile(r"pip3? +install[^\n`]* ['\"]?rampart(?![\w-]|/)"
                         r"|dependencies\s*=\s*\[\s*['\"]rampart['\"\[=<>~!]")
    found = [name for name in files if name and not name.startswith("docs/log/")
             and (ROOT / name).is_file() and foreign.search(
                 (ROOT / name).read_text(encoding="utf-8", errors="replace"))]
    assert found == []


@pytest.mark.parametrize("source", sorted((ROOT / "docs/images").glob("*.mmd")),
                         ids=lambda file: file.stem)
def test_diagrams_are_drawn_from_their_sources(source):
    """`make diagrams` was run after the last change."""
    text = source.read_text(encoding="utf-8")
    labels = re.findall(r"[\[({|]([^\[\](){}|]+)[\])}|]", text) + re.findall(r"\w: (.+)", text)
    words = re.findall(r"\w+", " ".join(labels))
    drawn = source.with_suffix(".svg").read_text(encoding="utf-8")
    assert words
    assert [word for word in words if word not in drawn and word != "br"] == []
