"""Fault trees in the Open-PSA Model Exchange Format (MEF 2.0d), in and out.

The reader takes everything that decides which sets of events make the top occur: gates with all
standard connectives, nested formulas, components with private names, house events. It skips
probabilities, parameters, labels, attributes and event trees, on which cut sets do not depend.
Common-cause groups, substitutions and includes would change the cut sets. The reader refuses them,
and every other element, attribute or text that it does not know.

Document type definitions, entities and external references are refused as well.
"""

from __future__ import annotations

import difflib
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Callable, Collection
from itertools import count
from typing import Any

import msgspec
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from rampart.files.plain_text import one_line, shown
from rampart.files.reading import FileError, check_size
from rampart.manager.analysis.formula import (
    GENERATED,
    Connective,
    Formula,
    FormulaError,
    first_few,
)
from rampart.manager.spec.schema import SystemSpec

CONNECTIVES = ("and", "or", "not", "xor", "nand", "nor", "iff", "imply", "atleast", "cardinality")
_TAKES = {"not": 1, "xor": 2, "iff": 2, "imply": 2}
"""Connectives with a fixed number of inputs."""

_NEGATED = frozenset({"not", "nand", "nor", "iff"})
REFERENCES = ("event", "gate", "basic-event", "house-event")
MAX_BYTES = 16 << 20
"""Of a file; published fault trees with thousands of gates have one or two million."""

_SKIPPED_IN_FORMULAS = frozenset({"label", "attributes"})
_CONTAINERS = ("define-fault-tree", "define-component", "model-data")
_DEFINITIONS = ("define-gate", "define-basic-event", "define-house-event")
_JOIN = "other files are not read; join them first, for example with 'xmllint --xinclude'"
_UNSUPPORTED = {
    "define-CCF-group": "common-cause groups would change the cut sets",
    "define-substitution": "substitutions would change the cut sets",
    "include": _JOIN, "{http://www.w3.org/2001/XInclude}include": _JOIN,
}
_SKIPPED = _SKIPPED_IN_FORMULAS | {
    "define-alignment", "define-consequence", "define-consequence-group", "define-event-tree",
    "define-functional-event", "define-initiating-event", "define-rule", "define-sequence",
    "define-parameter", "define-extern-library", "define-extern-function"}
_ATTRIBUTES = {
    "constant": {"value"}, "event": {"name", "type"}, "gate": {"name"}, "basic-event": {"name"},
    "house-event": {"name"}, "atleast": {"min"}, "cardinality": {"min", "max"},
    "define-gate": {"name", "role"}, "define-basic-event": {"name", "role"},
    "define-house-event": {"name", "role"}, "define-fault-tree": {"name", "role"},
    "define-component": {"name", "role"}}
_XML = "{http://www.w3.org/XML/1998/namespace}"
_MAX_DOUBTS = 20
"""Doubts that are reported of a file; more say nothing new."""

_Path = tuple[str, ...]


class OpenPsaError(ValueError):
    """A file that cannot be read. The message is one line: file, line, element, problem."""

    def __init__(self, where: str, problem: str) -> None:
        super().__init__(one_line(f"{where}: {problem}"))


class _Builder(ET.TreeBuilder):
    """Makes elements of XML and notes the line of each."""

    parser: Any  # expat's

    def __init__(self) -> None:
        super().__init__()
        self.lines: dict[ET.Element, int] = {}

    def start(self, tag: str, attrs: dict[str, str], /) -> ET.Element:
        """Open an element."""
        element = super().start(tag, attrs)
        self.lines[element] = self.parser.CurrentLineNumber
        return element


class _Definition(msgspec.Struct, frozen=True):
    """A definition whose formula has not been read yet."""

    element: ET.Element
    place: _Path
    private: bool

    @property
    def kind(self) -> str:
        """As references name it: "gate", "basic-event" or "house-event"."""
        return self.element.tag.removeprefix("define-")

    @property
    def name(self) -> str:
        """Unique among all definitions."""
        return ".".join(self.place) if self.private else self.place[-1]


Doubt = Callable[[OpenPsaError], None]


def read_open_psa(text: str | bytes, file: str, top: str = "",
                  doubt: Doubt = lambda _: None) -> Formula:
    """Read a fault tree. Spaces around names do not count.

    Args:
        text: XML.
        file: Name to use in messages.
        top: Name of the top gate; "" for the only gate that no other one uses.
        doubt: Called with each thing that is allowed and probably a mistake: an event that is
            used and not defined, names that differ only in case, an input twice, alignments. To
            refuse the file it raises what it is given.

    Raises:
        OpenPsaError: The text is not XML, is not MEF, or holds something unknown.
    """
    try:
        check_size(text, MAX_BYTES)
        builder = _Builder()
        parser = DefusedXMLParser(target=builder, forbid_dtd=True, forbid_entities=True,
                                  forbid_external=True)
        builder.parser = parser.parser
        parser.feed(text)
        root = parser.close()
    except DefusedXmlException as error:
        raise OpenPsaError(file, f"{type(error).__name__}: expected a file without document type "
                                 "definitions and entities") from None
    except FileError as error:
        raise OpenPsaError(file, str(error)) from None
    except (ET.ParseError, ValueError, LookupError) as error:
        raise OpenPsaError(file, f"not well-formed XML: {error}") from None
    if root.tag != "opsa-mef":
        raise OpenPsaError(file, f"{root.tag[:60]}: expected the root element 'opsa-mef'")
    return _Reader(root, builder.lines, file, doubt).formula(top)


class _Reader:
    """Reads one document."""

    def __init__(self, root: ET.Element, lines: dict[ET.Element, int], file: str, doubt: Doubt
                 ) -> None:
        self._lines = lines
        self._file = file
        self._report = doubt
        self._doubts = 0
        self._inside: ET.Element | None = None  # the definition that is being read
        self._undeclared: dict[str, tuple[ET.Element | None, ET.Element]] = {}
        self._definitions: list[_Definition] = []
        self._defined: dict[_Path, _Definition] = {}
        self._gates: dict[str, Connective] = {}
        self._basic: set[str] = set()
        self._house: dict[str, bool] = {}
        self._find_definitions(root)

    def _error(self, element: ET.Element | None, problem: str) -> OpenPsaError:
        if element is None:
            return OpenPsaError(self._file, problem)
        around = {} if self._inside is None else {self._inside: None}
        named = ", ".join(map(_label, {**around, element: None}))
        return OpenPsaError(f"{self._file}:{self._lines[element]}: {named}", problem)

    def _doubt(self, element: ET.Element | None, problem: str) -> None:
        self._doubts += 1
        if self._doubts <= _MAX_DOUBTS:
            self._report(self._error(element, problem))

    # -- definitions ----------------------------------------------------------------------------

    def _find_definitions(self, root: ET.Element) -> None:
        self._check_text(root)
        stack: list[tuple[ET.Element, _Path, bool]] = [
            (child, (), False) for child in reversed(root)]
        containers: dict[_Path, ET.Element] = {}
        while stack:
            element, place, private = stack.pop()
            tag = element.tag
            if tag in _UNSUPPORTED:
                raise self._error(element, f"not supported: {_UNSUPPORTED[tag]}")
            if tag == "define-alignment":
                self._doubt(element, "alignments are skipped: each house event has the state of "
                                     "its definition")
            if tag in _SKIPPED:
                continue
            self._check_known(element, (*_CONTAINERS, *_DEFINITIONS))
            role = element.get("role", "").strip()
            if role not in {"", "public", "private"}:
                raise self._error(element, f"role {shown(role)}: expected 'public' or 'private'")
            private = role == "private" or (private and role != "public")
            if tag != "model-data":
                name = _name(element)
                if not name or "." in name:
                    raise self._error(element, f"name {shown(name)}: expected a name without dots")
                place = (*place, name)
            if tag in _DEFINITIONS:
                definition = _Definition(element, place, private)
                for path in {place, place if private else (name,)}:
                    if path in self._defined:
                        raise self._twice(element, self._defined[path].element)
                    self._defined[path] = definition
                self._definitions.append(definition)
                continue
            if tag != "model-data" and containers.setdefault(place, element) is not element:
                raise self._twice(element, containers[place])
            self._check_text(element)
            stack += [(child, place, private) for child in reversed(element)]

    def _twice(self, element: ET.Element, first: ET.Element) -> OpenPsaError:
        return self._error(element, f"duplicate name, already defined in line "
                                    f"{self._lines[first]}")

    def _check_known(self, element: ET.Element, known: Collection[str],
                     what: str = "element") -> None:
        """Refuse an element, or an attribute of it, that the format does not have here."""
        tag = element.tag
        if tag not in known:
            near = difflib.get_close_matches(tag.rpartition("}")[2], known, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise self._error(element, f"unknown {what}; {hint}known: {', '.join(known)}")
        allowed = _ATTRIBUTES.get(tag, set())
        for name in element.attrib:
            if name not in allowed and not name.startswith(_XML):
                raise self._error(element, f"unknown attribute {shown(name)}; known: "
                                           f"{', '.join(sorted(allowed)) or 'none'}")

    def _check_text(self, element: ET.Element, *, empty: bool = False) -> None:
        """Refuse text where only elements have a meaning, and elements too if `empty`."""
        texts = (element.text, *(child.tail for child in element))
        stray = next((text.strip() for text in texts if text and text.strip()), "")
        if stray:
            raise self._error(element, f"unexpected text {shown(stray)}")
        if empty and len(element):
            raise self._error(element, f"unexpected element {shown(element[0].tag)} inside")

    # -- formulas -------------------------------------------------------------------------------

    def formula(self, top: str) -> Formula:
        """Return the formula of all definitions."""
        for definition in self._definitions:
            self._inside = definition.element
            if definition.kind == "gate":
                self._define_gate(definition)
            elif definition.kind == "house-event":
                self._house[definition.name] = self._state(definition.element)
            else:
                self._define_basic_event(definition)
        self._inside = None
        if top and top not in self._gates:
            raise self._error(None, f"unknown top gate {top!r}; known: {first_few(self._gates)}")
        self._warn_of_names()
        try:
            return Formula(self._gates, frozenset(self._basic), self._house, top)
        except FormulaError as error:
            raise self._error(None, str(error)) from None

    def _state(self, element: ET.Element) -> bool:
        """Return the state of a house event; without a constant it is false."""
        bodies = self._bodies(element)
        for body in bodies:
            self._check_known(body, ("constant",))
        if len(bodies) > 1:
            raise self._error(element, f"{len(bodies)} constants; expected one")
        return bool(bodies) and self._truth(bodies[0])

    def _define_basic_event(self, definition: _Definition) -> None:
        for inner in definition.element.iter():  # its probability does not matter
            if inner.tag in REFERENCES:
                raise self._error(definition.element, f"unexpected {inner.tag!r}; a basic event "
                                                      "has no formula")
        self._basic.add(definition.name)

    def _bodies(self, element: ET.Element) -> list[ET.Element]:
        self._check_text(element)
        return [child for child in element if child.tag not in _SKIPPED_IN_FORMULAS]

    def _truth(self, constant: ET.Element) -> bool:
        self._check_text(constant, empty=True)
        value = constant.get("value", "").strip()
        if value not in {"true", "false"}:
            raise self._error(constant, f"value {value!r}: expected 'true' or 'false'")
        return value == "true"

    def _define_gate(self, definition: _Definition) -> None:
        bodies = self._bodies(definition.element)
        if len(bodies) != 1:
            raise self._error(definition.element, f"{len(bodies)} formulas; expected one")
        name = definition.name
        pending = [(name, bodies[0])]
        place = definition.place[:-1]
        numbers = count(1)
        while pending:  # nested formulas become gates named after the one they are in
            own, body = pending.pop()
            if body.tag in REFERENCES:
                self._gates[own] = Connective((self._refer(body, place),), 1, 1)
                continue
            self._check_known(body, (*CONNECTIVES, "constant"), "connective")
            if body.tag == "constant":
                self._house[f"{own}{GENERATED}constant"] = self._truth(body)
                self._gates[own] = Connective((f"{own}{GENERATED}constant",), 1, 1)
                continue
            inputs = []
            for child in self._bodies(body):
                if child.tag in REFERENCES:
                    inputs.append(self._refer(child, place))
                else:
                    inputs.append(f"{name}{GENERATED}{next(numbers)}")
                    pending.append((inputs[-1], child))
            self._gates[own] = self._connective(own, body, inputs)

    def _refer(self, element: ET.Element, place: _Path) -> str:
        self._check_known(element, REFERENCES)
        self._check_text(element, empty=True)
        name = _name(element)
        found = self._resolve(name, place)
        kind = element.get("type", "").strip() if element.tag == "event" else element.tag
        if found is None:
            if kind in {"", "basic-event"} and name and "." not in name:
                self._basic.add(name)  # MEF lets basic events be declared by their use
                self._undeclared.setdefault(name, (self._inside, element))
                return name
            raise self._error(element, f"there is no {kind or 'event'} {name!r}")
        if kind and kind != found.kind:
            raise self._error(element, f"{name!r} is a {found.kind}, not a {kind}")
        return found.name

    def _resolve(self, name: str, place: _Path) -> _Definition | None:
        """Look a name up: in the innermost container first, then outwards, then in public."""
        parts = tuple(name.split("."))
        candidates = ((*place[:depth], *parts) for depth in range(len(place), -1, -1))
        return next((self._defined[candidate] for candidate in candidates
                     if candidate in self._defined), None)

    def _warn_of_names(self) -> None:
        """Report events that are used and not defined, and names that differ only in case."""
        defined = sorted(name for name in (*self._basic, *self._gates, *self._house)
                         if name not in self._undeclared and GENERATED not in name)
        if self._undeclared and self._undeclared.keys() >= self._basic:
            self._doubt(None, f"none of the {len(self._undeclared)} basic events is defined; a "
                              "misspelt name counts as another event")
        else:
            for name, (definition, element) in self._undeclared.items():
                if self._doubts >= _MAX_DOUBTS:
                    break
                self._inside = definition
                near = difflib.get_close_matches(name, defined, 1)
                self._doubt(element, f"event {name!r} is not defined, and counts as an independent "
                            "basic event" + (f"; did you mean {near[0]!r}?" if near else ""))
        alike = defaultdict[str, list[str]](list)
        for name in (*defined, *self._undeclared):
            alike[name.casefold()].append(name)
        for names in alike.values():
            if len(names) > 1:
                self._doubt(None, f"names that differ only in case: {first_few(names)}")

    def _connective(self, name: str, element: ET.Element, inputs: list[str]) -> Connective:
        tag, count = element.tag, len(inputs)
        if not count:
            raise self._error(element, "empty gate; expected inputs")
        if count != _TAKES.get(tag, count):
            raise self._error(element, f"{count} inputs; {tag!r} takes {_TAKES[tag]}")
        if twice := next((entry for entry, times in Counter(inputs).items() if times > 1), ""):
            problem = f"input {shown(twice)} is listed twice"
            if tag not in {"and", "or", "nand", "nor"}:  # which do not count
                raise self._error(element, f"{problem}; {tag!r} counts its inputs")
            self._doubt(element, problem)
        low, high = 1, count
        match tag:
            case "atleast":
                low = self._number(element, "min", count)
            case "cardinality":
                low = self._number(element, "min", count)
                high = self._number(element, "max", count)
                if low > high:
                    raise self._error(element, f"min = {low} is more than max = {high}")
            case "imply":
                self._gates[f"{name}{GENERATED}not"] = Connective((inputs[0],), 1, 1, negated=True)
                inputs = [f"{name}{GENERATED}not", inputs[1]]
            case "xor" | "iff":
                high = 1
            case "and" | "nand":
                low = count
        return Connective(tuple(inputs), low, high, negated=tag in _NEGATED)

    def _number(self, element: ET.Element, attribute: str, count: int) -> int:
        text = element.get(attribute, "").strip()
        least = 1 if element.tag == "atleast" else 0
        if not text.isdecimal() or len(text) > 9 or not least <= int(text) <= count:
            raise self._error(element, f"{attribute} = {text!r}: expected a number from {least} to "
                                       f"{count}, the number of inputs")
        return int(text)


def _name(element: ET.Element) -> str:
    return element.get("name", "").strip()


def _label(element: ET.Element) -> str:
    name = _name(element)
    return f"{element.tag[:60]} {shown(name)}" if name else element.tag[:60]


def write_open_psa(spec: SystemSpec) -> str:
    """Return a system's fault tree as MEF.

    Titles become labels. An event with a barrier gets an attribute that names the mechanism.
    """
    root = ET.Element("opsa-mef")
    tree = ET.SubElement(root, "define-fault-tree", name=spec.name)
    data = ET.SubElement(root, "model-data")
    barriers = {mechanism.event: mechanism.name for mechanism in spec.mechanisms}
    gates = {event.name for event in spec.events if event.required}
    for event in spec.events:
        element = (ET.SubElement(tree, "define-gate", name=event.name) if event.required else
                   ET.SubElement(data, "define-basic-event", name=event.name))
        if event.title:
            ET.SubElement(element, "label").text = event.title
        if event.name in barriers:
            attributes = ET.SubElement(element, "attributes")
            ET.SubElement(attributes, "attribute", name="barrier", value=barriers[event.name])
        if event.required:
            kind = {1: "or", len(event.of): "and"}.get(event.required, "atleast")
            # Other tools refuse a connective of one input: it is that input.
            gate = element if len(event.of) == 1 else ET.SubElement(
                element, kind, {"min": str(event.required)} if kind == "atleast" else {})
            for entry in event.of:
                ET.SubElement(gate, "gate" if entry in gates else "basic-event", name=entry)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
