"""Open-PSA files: what other tools write, and what nobody should."""

import re
import subprocess
import xml.etree.ElementTree as ET
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.manager.analysis.cut_sets import CutSets
from rampart.manager.analysis.formula import formula_of
from rampart.manager.analysis.open_psa import OpenPsaError, read_open_psa, write_open_psa
from rampart.manager.spec.specification import parse_specification
from tests import system_file

SYSTEMS = pytest.mark.parametrize("system", ["paper", "osmosis", "cell"])


def mef(*definitions: str, data: str = "") -> str:
    return ('<?xml version="1.0"?><opsa-mef><define-fault-tree name="ft">'
            + "".join(definitions) + f"</define-fault-tree>{data}</opsa-mef>")


def gate(name: str, body: str, attributes: str = "") -> str:
    return f'<define-gate name="{name}"{attributes}>{body}</define-gate>'


def events(*names: str) -> str:
    return "".join(f'<basic-event name="{name}"/>' for name in names)


def declared(*names: str) -> str:
    return "".join(f'<define-basic-event name="{name}"/>' for name in names)


def cut_sets(text: str, top: str = "") -> set[frozenset[str]]:
    return {frozenset(s) for s in CutSets(read_open_psa(text, "f.xml", top)).sets()}


def sets(*texts: str) -> set[frozenset[str]]:
    return {frozenset(text.split()) for text in texts}


PRIVATE = gate("g", f"<or>{events('e')}</or>", ' role="private"') + \
    '<define-basic-event name="e" role="private"/>'


@pytest.mark.parametrize(("text", "expected"), [
    *((mef(gate("top", body)), expected) for body, expected in (
        (f'<cardinality min="1" max="1">{events("a", "b")}</cardinality>', sets("a", "b")),
        (f'<or>{events("a")}<constant value="true"/></or>', sets("")),
        (f'<or>{events("a")}<constant value="false"/></or>', sets("a")),
        ('<event name="a"/>', sets("a")),
        ('<event name="a" type="basic-event"/>', sets("a")),
        ("<or>" * 4000 + events("a") + "</or>" * 4000, sets("a")))),
    # a house event is a constant wherever it is defined
    (mef(gate("top", '<and><house-event name="h"/><basic-event name="a"/></and>'),
         data='<model-data><define-house-event name="h"><constant value="true"/>'
              "</define-house-event></model-data>"), sets("a")),
    # private names of components do not meet
    (mef(gate("top", '<and><gate name="left.g"/><gate name="right.g"/></and>'),
         *(f'<define-component name="{side}">{PRIVATE}</define-component>'
           for side in ("left", "right"))), sets("ft.left.e ft.right.e")),
    # spaces around a name do not make it another one
    (mef(gate("top", '<and><gate name="left "/><gate name="right"/></and>'),
         gate("left", f"<or>{events('pump', 'v')}</or>"),
         gate(" right", f"<or>{events(' pump ', 'w')}</or>"), declared("pump\t", "v", "w")),
     sets("pump", "v w")),
], ids=lambda part: str(part)[50:90])
def test_what_may_be_written_has_its_meaning(text, expected):
    assert cut_sets(text) == expected


HOLDS = {
    "and": lambda inputs, _: all(inputs), "or": lambda inputs, _: any(inputs),
    "nand": lambda inputs, _: not all(inputs), "nor": lambda inputs, _: not any(inputs),
    "not": lambda inputs, _: not inputs[0], "xor": lambda inputs, _: inputs[0] != inputs[1],
    "iff": lambda inputs, _: inputs[0] == inputs[1],
    "imply": lambda inputs, _: not inputs[0] or inputs[1],
    "atleast": lambda inputs, k: sum(inputs) >= k,
}
"""What each connective means, said once more."""

LEAVES = st.sampled_from([*"abcde", "top/lone", "top/1", "top/not"])


def several(parts: st.SearchStrategy[Any], least: int, most: int) -> st.SearchStrategy[list[Any]]:
    """Return lists without a name twice, which a connective that counts refuses."""
    return st.lists(parts, min_size=least, max_size=most, unique_by=repr)


def inner(parts: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Return formulas (connective, inputs, k) over parts."""
    return st.one_of(
        st.tuples(st.sampled_from(["and", "or", "nand", "nor"]),
                  several(parts, 1, 4), st.just(0)),
        st.tuples(st.just("not"), st.lists(parts, min_size=1, max_size=1), st.just(0)),
        st.tuples(st.sampled_from(["xor", "iff", "imply"]),
                  several(parts, 2, 2), st.just(0)),
        st.tuples(st.just("atleast"), several(parts, 2, 4),
                  st.integers(1, 2)))


FORMULAS = inner(st.recursive(LEAVES, inner, max_leaves=12))


def written(formula: Any, gates: dict[str, Any]) -> str:
    if isinstance(formula, str):
        return f'<{"gate" if formula in gates else "basic-event"} name="{formula}"/>'
    tag, parts, k = formula
    least = f' min="{k}"' if k else ""
    return f"<{tag}{least}>{''.join(written(part, gates) for part in parts)}</{tag}>"


def holds(formula: Any, gates: dict[str, Any], occurred: frozenset[str]) -> bool:
    if isinstance(formula, str):
        return holds(gates[formula], gates, occurred) if formula in gates else formula in occurred
    tag, parts, k = formula
    return HOLDS[tag]([holds(part, gates, occurred) for part in parts], k)


@given(FORMULAS, inner(st.sampled_from("abcde")), inner(st.sampled_from("abcde")))
def test_nested_formulas_have_the_minimal_sets_that_brute_force_finds(top, lone, negation):
    gates = {"top/lone": lone, "top/not": negation}  # names that a reader might make up as well
    text = mef(gate("top", written(top, gates)),
               *(gate(name, written(body, gates)) for name, body in gates.items()))
    minimal: list[frozenset[str]] = []
    for size in range(7):
        for chosen in map(frozenset, combinations([*"abcde", "top/1"], size)):
            if holds(top, gates, chosen) and not any(smaller <= chosen for smaller in minimal):
                minimal.append(chosen)
    assert cut_sets(text, "top") == set(minimal)


@SYSTEMS
def test_what_is_exported_comes_back_the_same_and_raises_no_doubt(system):
    path, doubts = system_file(system), list[OpenPsaError]()
    spec = parse_specification(path.read_text(encoding="utf-8"), path.name)
    text, there = write_open_psa(spec), formula_of(spec.build_fault_tree())
    back = read_open_psa(text, "out.xml", doubt=doubts.append)
    assert set(CutSets(back).sets()) == set(CutSets(there).sets())
    assert (back.top, doubts) == (there.top, [])
    for connective in ("or", "and", "atleast"):  # in paper a crash alone stops localization
        assert all(len(found) > 1 for found in ET.fromstring(text).iter(connective))
    if system == "paper":
        assert "<label>Moving inside a prohibited area</label>" in text
        assert '<attribute name="barrier" value="FTM1" />' in text


INCLUDE = ('<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="more.xml" '
           'xpointer="xpointer(/opsa-mef/*)"/>')
BOMB = ('<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
        "<opsa-mef>&b;</opsa-mef>")
EXTERNAL = ('<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
            "<opsa-mef>&a;</opsa-mef>")


@pytest.mark.parametrize(("text", "words"), [
    (BOMB, "without document type definitions and entities"),
    (EXTERNAL, "without document type definitions and entities"),
    *((junk, "not well-formed XML") for junk in (
        "<opsa-mef>", "", b"\xff\xfe", b"\x00", b"<?xml version='1.0' encoding='x'?>")),
    ("<html/>", "html: expected the root element 'opsa-mef'"),
    (mef(gate("top", "")), "0 formulas; expected one"),
    (mef(gate("top", f"<or>{events('a')}</or>"), gate("top", f"<or>{events('b')}</or>")),
     "define-gate 'top': duplicate name, already defined in line 1"),
    (mef(gate("top", '<or><house-event name="a"/></or>'), '<define-basic-event name="a"/>'),
     "'a' is a basic-event, not a house-event"),
    (mef(gate("top", '<or><gate name="g"/></or>'), gate("g", '<or><gate name="h"/></or>'),
         gate("h", '<or><gate name="g"/></or>')), "cycle g > h > g"),
    *((mef(gate("top", body)), f"define-gate 'top', {words}") for body, words in (
        ("<or></or>", "or: empty gate"),
        ('<or><gate name="g7"/></or>', "gate 'g7': there is no gate 'g7'"),
        (f'<atleast min="4">{events("a", "b", "c")}</atleast>', "atleast: min = '4': expected"),
        (f'<cardinality min="2" max="1">{events("a", "b")}</cardinality>', "cardinality: min = 2"),
        (f"<xor>{events('a')}</xor>", "xor: 1 inputs; 'xor' takes 2"),
        (f"<maybe>{events('a')}</maybe>", "maybe: unknown connective; known: and, or"),
        ('<or><constant value="maybe"/></or>', "constant: value 'maybe': expected"))),
    (mef(gate("a", f"<or>{events('x')}</or>"), gate("b", f"<or>{events('x')}</or>")),
     "2 gates are not an input of another gate: a, b; name the top gate"),
    (mef(), "no gates; expected a top gate"),
    (mef(gate("", f"<or>{events('x')}</or>")), "define-gate: name '': expected a name"),
    # each was read over, with cut sets too few, or too large, and no word of it
    *((text, f"{where}: ") for text, where in (
        (mef(gate("top", '<or><event name="a"/><event name="g"/></or>'), INCLUDE), "include"),
        (mef(gate("top", '<or><event name="a"/><event name="g"/></or>'),
             '<define-Gate name="g"><and><event name="b"/><event name="c"/></and></define-Gate>'),
         "define-Gate 'g'"),
        (mef(gate("top", '<or><event name="a"/><event name="g"/></or>'),
             '<x:define-gate xmlns:x="urn:x" name="g"><event name="b"/></x:define-gate>'),
         "{urn:x}define-gate 'g'"),
        (mef('<define-component name="c"><define-gate name="g"><event name="a"/></define-gate>'
             '</define-component>', '<define-component name="c"/>',
             gate("top", '<or><gate name="c.g"/></or>')), "define-component 'c'"),
        (mef(gate("top", f'<atleast min="2">{events("a", "a", "b")}</atleast>')), "atleast"),
        (mef(gate("top", f"<xor>{events('a', 'a')}</xor>")), "xor"),
        (mef(gate("top", f'<or k="2">{events("a", "b")}</or>')), "or"),
        (mef(gate("top", f"<or>{events('a')} a b c </or>")), "or"),
        (mef(gate("top", f"<or>{events('a')}</or>"), "and c"), "define-fault-tree 'ft'"),
        (mef(gate("top", '<or><basic-event name="a"><or/></basic-event></or>')),
         "basic-event 'a'"),
        (mef(gate("top", '<or><event name="g"/></or>'),
             f'<define-basic-event name="g"><and>{events("a", "b")}</and></define-basic-event>'),
         "define-basic-event 'g'"),
        (mef(gate("top", '<and><house-event name="h"/><event name="a"/></and>'),
             '<define-house-event name="h"><bool value="true"/></define-house-event>'), "bool"),
        (mef(gate("top", '<or><constant Value="true"/></or>')), "constant"),
        (mef(gate("top", f"<or>{events('a')}</or>", ' role="privat"')), "define-gate 'top'"),
        (mef(gate("top", '<or><event name="a" typ="gate"/></or>')), "event 'a'"))),
])
def test_refused(text, words):
    with pytest.raises(OpenPsaError) as caught:
        read_open_psa(text, "f.xml")
    assert str(caught.value).startswith("f.xml:")
    assert words in str(caught.value)


def test_the_top_may_be_chosen_and_the_line_of_a_mistake_is_told():
    text = mef(gate("one", f"<or>{events('a')}</or>"), gate("two", f"<or>{events('b')}</or>"))
    assert cut_sets(text, "two") == sets("b")
    with pytest.raises(OpenPsaError, match="unknown top gate 'x'; known: one, two"):
        cut_sets(text, "x")
    with pytest.raises(OpenPsaError, match=r"^f\.xml:5: "):
        cut_sets(mef("\n", gate("top", "\n<or>\n" + events("a") + '\n<gate name="g7"/></or>')))


@pytest.mark.parametrize(("text", "words"), [
    (mef(gate("top", f"<and>{events('pump', 'pmup')}</and>"), declared("pump")),
     ("top", "'pmup'", "'pump'")),
    (mef(gate("top", f"<and>{events('pump', 'pmup')}</and>")), ("none of the 2",)),
    (mef(gate("top", f"<and>{events('pump', 'Pump')}</and>"), declared("pump", "Pump")),
     ("Pump, pump",)),
    (mef(gate("top", f"<and>{events('a', 'a')}</and>"), declared("a")), ("'a'", "twice")),
    (mef(gate("top", f"<and>{events('a')}</and>"), declared("a"),
         data='<define-alignment name="day"/>'), ("define-alignment 'day'",)),
])
def test_what_is_probably_a_mistake_is_reported_and_refused_if_asked_for(text, words):
    doubts: list[OpenPsaError] = []
    read_open_psa(text, "f.xml", doubt=doubts.append)
    (doubt,) = doubts
    assert all(word in str(doubt) for word in words)

    def refuse(error: OpenPsaError) -> None:
        raise error

    with pytest.raises(OpenPsaError):
        read_open_psa(text, "f.xml", doubt=refuse)


# -- beside SCRAM, an independent program: its own inputs, and exports


SCRAM = pytest.mark.nightly
"""Needs Debian's package `scram` (GPL-3, neither linked nor shipped): `make test-nightly` asks."""

INPUTS = Path("/usr/share/scram/input")
ALL = 1000
"""Sets of at most so many events; SCRAM's own default leaves out those of more than 20."""

ORDERS = {"CEA9601": 4}
"""Of inputs of which SCRAM does not count all sets within a minute."""

WITHOUT_COUNT = {
    "high-prob", "mcs_prob", "mixed_mcs_prob",  # probabilities only
    "attack", "bcd", "mef_example", "event_tree", "gas_leak",  # event trees
    "common_cause", "substitutions", "nondeclarative_substitutions",  # refused: other sets
    "attack_alignment", "two_train_alignment",  # phases of a mission, each with counts of its own
    "config"}


def count(folder: Path, *files: Path, order: int = ALL) -> dict[str, int]:
    """Return SCRAM's number of minimal cut sets of each top."""
    output = folder / "scram.xml"
    done = subprocess.run(
        ["scram", *map(str, files), "--limit-order", str(order), "-o", str(output)],
        check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return {top: int(products) for top, products in re.findall(
        r'<sum-of-products name="([^"]*)"[^>]* products="(\d+)"', output.read_text())}


def inputs() -> list[Path]:
    """Return the fault trees among SCRAM's inputs."""
    return sorted(path for path in INPUTS.rglob("*.xml") if path.stem not in WITHOUT_COUNT
                  and not path.stem.endswith("-basic-events"))


@SCRAM
@pytest.mark.timeout(1800)
def test_the_inputs_of_scram_have_as_many_cut_sets_as_scram_finds(tmp_path):
    compared = 0
    for path in inputs():
        order = ORDERS.get(path.stem, ALL)
        events = path.with_name(f"{path.stem}-basic-events.xml")
        found = count(tmp_path, path, *([events] if events.exists() else []), order=order)
        for top, expected in found.items():
            tree = read_open_psa(path.read_text(encoding="utf-8"), path.name, top)
            assert CutSets(tree, max_order=order).count == expected, (path, top)
            compared += 1
    assert compared >= 13


@SCRAM
@pytest.mark.timeout(1800)
@SYSTEMS
def test_an_exported_system_has_as_many_cut_sets_in_scram(tmp_path, system):
    file = system_file(system)
    spec = parse_specification(file.read_text(encoding="utf-8"), file.name)
    path = tmp_path / "export.xml"
    path.write_text(write_open_psa(spec), encoding="utf-8")
    ours = CutSets(read_open_psa(path.read_text(encoding="utf-8"), path.name))
    assert list(count(tmp_path, path).values()) == [ours.count]
