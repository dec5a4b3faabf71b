"""Fault trees in the Open-PSA Model Exchange Format (MEF 2.0d), in and out.

Read are fault trees with everything that decides which sets of events make the top occur: gates
with all standard connectives, nested formulas, components with private names, house events.
Probabilities, parameters, labels, attributes and event trees are accepted and left aside: cut sets
do not depend on them. Common-cause groups, substitutions and includes would change the cut sets.
They are refused, and so is every other element, attribute or text that the reader does not know.

XML from strangers is read without document type definitions, entities, or anything external.
"""

from __future__ import annotations

import difflib
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from functools import partial
from itertools import count

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

_PATH_SHOWN = 300
"""Characters of a path beyond which nothing is added to it."""

_ASIDE = frozenset({"label", "attributes"})
_CONTAINERS = ("define-fault-tree", "define-component", "model-data")
_DEFINITIONS = {"define-gate": "gate", "define-basic-event": "basic-event",
                "define-house-event": "house-event"}
_JOIN = "other files are not read; join them first, for example with 'xmllint --xinclude'"
_UNSUPPORTED = {
    "define-CCF-group": "common-cause groups would change the cut sets",
    "define-substitution": "substitutions would change the cut sets",
    "include": _JOIN, "{http://www.w3.org/2001/XInclude}include": _JOIN,
}
_OF_EVENT_TREES = frozenset({
    "define-alignment", "define-consequence", "define-consequence-group", "define-event-tree",
    "define-functional-event", "define-initiating-event", "define-rule", "define-sequence"})
_LEFT_ASIDE = _ASIDE | _OF_EVENT_TREES | {
    "define-parameter", "define-extern-library", "define-extern-function"}
_ATTRIBUTES = {
    "constant": {"value"}, "event": {"name", "type"}, "gate": {"name"}, "basic-event": {"name"},
    "house-event": {"name"}, "atleast": {"min"}, "cardinality": {"min", "max"},
    "define-gate": {"name", "role"}, "define-basic-event": {"name", "role"},
    "define-house-event": {"name", "role"}, "define-fault-tree": {"name", "role"},
    "define-component": {"name", "role"}}
_XML = "{http://www.w3.org/XML/1998/namespace}"
_WARNED_OF = 20
"""Doubts that are reported of a file; more say nothing new."""

_Path = tuple[str, ...]


class OpenPsaError(ValueError):
    """A file that cannot be read. The message is one line: file, line, path, what is wrong.

    Args:
        file: Name of the file.
        path: Of the element.
        problem: What is wrong with it.
        line: Of the element in the file; 0 if the problem is the file's.
    """

    def __init__(self, file: str, path: str, problem: str, line: int = 0) -> None:
        where = f"{file}:{line}" if line else file
        super().__init__(one_line(f"{where}: {path}: {problem}"))


class _Element(ET.Element):
    """An element that knows its line."""

    line = 0


class _Builder(ET.TreeBuilder):
    """Makes elements of XML that know their line; `line` returns where the parser is."""

    line: Callable[[], int]

    def start(self, tag: str, attrs: dict[str, str], /) -> ET.Element:
        """Open an element."""
        element = super().start(tag, attrs)
        element.line = self.line()  # type: ignore[attr-defined]  # made by the factory
        return element


class _Definition(msgspec.Struct, frozen=True):
    """A definition, before names are resolved."""

    kind: str
    path: str
    place: _Path
    private: bool
    element: _Element

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
        OpenPsaError: The text is not XML, or not MEF, or has something that is not understood.
    """
    try:
        check_size(text, MAX_BYTES)
        builder = _Builder(element_factory=_Element)
        parser = DefusedXMLParser(target=builder, forbid_dtd=True, forbid_entities=True,
                                  forbid_external=True)
        builder.line = lambda: parser.parser.CurrentLineNumber
        parser.feed(text)
        root = parser.close()
    except DefusedXmlException as error:
        raise OpenPsaError(file, "/", f"{type(error).__name__}: document type definitions and "
                                      "entities are not read; leave them out") from None
    except FileError as error:
        raise OpenPsaError(file, "/", str(error)) from None
    except (ET.ParseError, ValueError, LookupError) as error:
        raise OpenPsaError(file, "/", f"not well-formed XML: {error}") from None
    if root.tag != "opsa-mef":
        raise OpenPsaError(file, f"/{root.tag[:60]}", "expected the root element 'opsa-mef'")
    return _Reader(root, file, doubt).formula(top)


class _Reader:
    """Reads one document."""

    def __init__(self, root: _Element, file: str, doubt: Doubt) -> None:
        self._error = partial(OpenPsaError, file)
        self._doubts = 0
        self._report = doubt
        self._undeclared: dict[str, tuple[str, int]] = {}
        self._definitions: dict[_Path, _Definition] = {}
        self._public: dict[str, _Definition] = {}
        self._gates: dict[str, Connective] = {}
        self._basic: set[str] = set()
        self._house: dict[str, bool] = {}
        for definition in self._find(root):
            name = definition.place[-1]
            earlier = self._definitions.get(definition.place) or (
                None if definition.private else self._public.get(name))
            if earlier is not None:
                raise self._error(definition.path,
                                  f"duplicate name {name!r}, already defined at {earlier.path}",
                                  definition.element.line)
            self._definitions[definition.place] = definition
            if not definition.private:
                self._public[name] = definition

    # -- definitions ----------------------------------------------------------------------------

    def _find(self, root: _Element) -> Iterator[_Definition]:
        stack: list[tuple[_Element, str, _Path, bool]] = [(root, "/opsa-mef", (), False)]
        containers: dict[_Path, str] = {}
        while stack:
            parent, path, place, private = stack.pop()
            inner = []
            counts = Counter[str]()
            self._check_text(parent, path)
            element: _Element
            for element in parent:  # type: ignore[assignment]  # made by the factory
                tag, line = element.tag, element.line
                counts[tag] += 1
                name = element.get("name", "").strip()
                here = f"{path}/{tag}[{f'@name={shown(name)}' if name else counts[tag]}]"
                if tag in _UNSUPPORTED:
                    raise self._error(here, f"not supported: {_UNSUPPORTED[tag]}", line)
                if tag in _LEFT_ASIDE:
                    if tag == "define-alignment":
                        self._doubt(here, "alignments are left aside: each house event has the "
                                          "state of its definition", line)
                    continue
                self._check_known(element, here, (*_CONTAINERS, *_DEFINITIONS))
                role = element.get("role", "").strip()
                if role not in {"", "public", "private"}:
                    raise self._error(here, f"role {shown(role)}: expected 'public' or 'private'",
                                      line)
                hidden = role == "private" or (private and role != "public")
                if tag == "model-data":
                    inner.append((element, here, place, hidden))
                    continue
                own = (*place, self._checked(name, here, line))
                if tag in _DEFINITIONS:
                    yield _Definition(_DEFINITIONS[tag], here, own, hidden, element)
                    continue
                if own in containers:
                    raise self._error(here, f"duplicate name {name!r}, already defined at "
                                            f"{containers[own]}", line)
                containers[own] = f"{here}, line {line}"
                inner.append((element, here, own, hidden))
            stack.extend(reversed(inner))

    def _checked(self, name: str, path: str, line: int) -> str:
        if not name or "." in name:
            raise self._error(path, f"name {shown(name)}: expected a name without dots", line)
        return name

    def _check_known(self, element: _Element, path: str, known: Collection[str],
                     what: str = "element") -> None:
        """Refuse an element, or an attribute of one, that the format does not have here."""
        tag, line = element.tag, element.line
        if tag not in known:
            near = difflib.get_close_matches(tag.rpartition("}")[2], known, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise self._error(path, f"unknown {what}; {hint}known: {', '.join(known)}", line)
        allowed = _ATTRIBUTES.get(tag, set())
        for name in element.attrib:
            if name not in allowed and not name.startswith(_XML):
                raise self._error(path, f"unknown attribute {shown(name)}; known: "
                                        f"{', '.join(sorted(allowed)) or 'none'}", line)

    def _check_text(self, element: _Element, path: str, *, empty: bool = False) -> None:
        """Refuse text where only elements have a meaning, and where it has to be `empty` these."""
        texts = (element.text, *(child.tail for child in element))
        stray = next((text.strip() for text in texts if text and text.strip()), "")
        if stray:
            raise self._error(path, f"unexpected text {shown(stray)}", element.line)
        if empty and len(element):
            raise self._error(path, f"unexpected element {shown(element[0].tag)} inside",
                              element.line)

    def _doubt(self, path: str, problem: str, line: int) -> None:
        self._doubts += 1
        if self._doubts <= _WARNED_OF:
            self._report(self._error(path, problem, line))

    # -- formulas -------------------------------------------------------------------------------

    def formula(self, top: str) -> Formula:
        """Return the formula of all definitions."""
        for definition in self._definitions.values():
            if definition.kind == "gate":
                self._define_gate(definition)
            elif definition.kind == "house-event":
                self._house[definition.name] = self._state(definition)
            else:
                self._define_basic_event(definition)
        if top and top not in self._gates:
            raise self._error("/opsa-mef", f"unknown top gate {top!r}; known: "
                                           f"{first_few(self._gates)}")
        self._warn_of_names()
        try:
            return Formula(self._gates, frozenset(self._basic), self._house, top)
        except FormulaError as error:
            raise self._error("/opsa-mef", str(error)) from None

    def _state(self, definition: _Definition) -> bool:
        """Return the state of a house event: false, as the format has it, unless it says one."""
        bodies = self._bodies(definition)
        for body in bodies:
            self._check_known(body, f"{definition.path}/{body.tag}", ("constant",))
        if len(bodies) > 1:
            raise self._error(definition.path, f"{len(bodies)} constants; a house event has one",
                              definition.element.line)
        return bool(bodies) and self._truth(bodies[0], definition.path)

    def _define_basic_event(self, definition: _Definition) -> None:
        """Note a basic event. Its probability is left aside, and must be one, not a formula."""
        for inner in definition.element.iter():
            if inner.tag in REFERENCES:
                raise self._error(definition.path, f"a basic event has no formula, found "
                                                   f"{inner.tag!r}", definition.element.line)
        self._basic.add(definition.name)

    def _bodies(self, definition: _Definition) -> list[_Element]:
        self._check_text(definition.element, definition.path)
        return [child for child in definition.element  # type: ignore[misc]  # of the factory
                if child.tag not in _ASIDE]

    def _truth(self, constant: _Element, path: str) -> bool:
        self._check_text(constant, f"{path}/constant", empty=True)
        value = constant.get("value", "").strip()
        if value not in {"true", "false"}:
            raise self._error(f"{path}/constant", f"value {value!r}: expected 'true' or 'false'",
                              constant.line)
        return value == "true"

    def _define_gate(self, definition: _Definition) -> None:
        bodies = self._bodies(definition)
        if len(bodies) != 1:
            raise self._error(definition.path, f"{len(bodies)} formulas; a gate has exactly one",
                              definition.element.line)
        name = definition.name
        pending = [(name, bodies[0], definition.path)]
        place = definition.place[:-1]
        numbers = count(1)
        while pending:  # nested formulas become gates named after the one they are in
            own, body, path = pending.pop()
            here = f"{path}/{body.tag}" if len(path) < _PATH_SHOWN else f"{path[:_PATH_SHOWN]}..."
            if body.tag not in REFERENCES:
                self._check_known(body, here[:200], (*CONNECTIVES, "constant"), "connective")
            if body.tag in REFERENCES:
                self._gates[own] = Connective((self._refer(body, place, here),), 1, 1)
            elif body.tag == "constant":
                self._house[f"{own}{GENERATED}constant"] = self._truth(body, path)
                self._gates[own] = Connective((f"{own}{GENERATED}constant",), 1, 1)
            else:
                self._check_text(body, here)
                inputs = []
                child: _Element
                for child in body:  # type: ignore[assignment]  # made by the factory
                    if child.tag in REFERENCES:
                        inputs.append(self._refer(child, place, here))
                    elif child.tag not in _ASIDE:
                        nested = f"{name}{GENERATED}{next(numbers)}"
                        pending.append((nested, child, here))
                        inputs.append(nested)
                self._gates[own] = self._connective(own, body, inputs, here)

    def _refer(self, element: _Element, place: _Path, path: str) -> str:
        name = element.get("name", "").strip()
        here = f"{path}/{element.tag}[@name={shown(name)}]"
        self._check_known(element, here, REFERENCES)
        self._check_text(element, here, empty=True)
        found = self._resolve(name, place)
        kind = element.get("type", "").strip() if element.tag == "event" else element.tag
        if found is None:
            if kind in {"", "basic-event"} and name and "." not in name:
                self._basic.add(name)  # MEF lets basic events be declared by their use
                self._undeclared.setdefault(name, (here, element.line))
                return name
            raise self._error(here, f"there is no {kind or 'event'} {name!r}", element.line)
        if kind and kind != found.kind:
            raise self._error(here, f"{name!r} is a {found.kind}, not a {kind}", element.line)
        return found.name

    def _resolve(self, name: str, place: _Path) -> _Definition | None:
        """Look a name up: in the innermost container first, then outwards, then in public."""
        parts = tuple(name.split("."))
        candidates = ((*place[:depth], *parts) for depth in range(len(place), -1, -1))
        return next((self._definitions[candidate] for candidate in candidates
                     if candidate in self._definitions), self._public.get(name))

    def _warn_of_names(self) -> None:
        """Report events that are used and not defined, and names that differ only in case."""
        used = list(self._undeclared)
        defined = sorted(name for name in (*self._basic, *self._gates, *self._house)
                         if name not in self._undeclared and GENERATED not in name)
        if self._undeclared and self._undeclared.keys() >= self._basic:
            self._doubt("/opsa-mef", f"none of the {len(self._undeclared)} basic events is "
                                     "defined; a misspelt name counts as another event", 0)
            self._undeclared.clear()
        for name, (path, line) in self._undeclared.items():
            if self._doubts >= _WARNED_OF:
                break
            near = difflib.get_close_matches(name, defined, 1)
            self._doubt(path, f"event {name!r} is not defined, and counts as an independent basic "
                              "event" + (f"; did you mean {near[0]!r}?" if near else ""), line)
        alike = defaultdict[str, list[str]](list)
        for name in (*defined, *used):
            alike[name.casefold()].append(name)
        for names in alike.values():
            if len(names) > 1:
                self._doubt("/opsa-mef", "names that differ only in case: "
                                         f"{first_few(names)}", 0)

    def _connective(self, name: str, element: _Element, inputs: list[str], path: str
                    ) -> Connective:
        tag, count, line = element.tag, len(inputs), element.line
        if not count:
            raise self._error(path, "empty gate; it needs inputs", line)
        if count != _TAKES.get(tag, count):
            raise self._error(path, f"{count} inputs; {tag!r} takes {_TAKES[tag]}", line)
        if twice := next((entry for entry, times in Counter(inputs).items() if times > 1), ""):
            problem = f"input {shown(twice)} is there twice"
            if tag not in {"and", "or", "nand", "nor"}:  # which do not count
                raise self._error(path, f"{problem}; {tag!r} counts its inputs", line)
            self._doubt(path, problem, line)
        low, high = 1, count
        match tag:
            case "atleast":
                low = self._number(element, "min", count, path)
            case "cardinality":
                low = self._number(element, "min", count, path)
                high = self._number(element, "max", count, path)
                if low > high:
                    raise self._error(path, f"min = {low} is more than max = {high}", line)
            case "imply":
                self._gates[f"{name}{GENERATED}not"] = Connective((inputs[0],), 1, 1, negated=True)
                inputs = [f"{name}{GENERATED}not", inputs[1]]
            case "xor" | "iff":
                high = 1
            case "and" | "nand":
                low = count
        return Connective(tuple(inputs), low, high, negated=tag in _NEGATED)

    def _number(self, element: _Element, attribute: str, count: int, path: str) -> int:
        text = element.get(attribute, "").strip()
        least = 1 if element.tag == "atleast" else 0
        if not text.isdecimal() or len(text) > 9 or not least <= int(text) <= count:
            raise self._error(path, f"{attribute} = {text!r}: expected a number from {least} to "
                                    f"{count}, the inputs", element.line)
        return int(text)


def write_open_psa(spec: SystemSpec) -> str:
    """Return a system's fault tree as MEF.

    Titles become labels; on which events mechanisms are barriers becomes an attribute.
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
