"""Fault trees in the Open-PSA Model Exchange Format (MEF 2.0d), in and out.

Read are fault trees with everything that decides which sets of events make the top occur: gates
with all standard connectives, nested formulas, components with private names, house events.
Probabilities, parameters, labels, attributes and event trees are accepted and left aside: cut sets
do not depend on them. Common-cause groups and substitutions would change the cut sets and are
refused.

XML from strangers is read without document type definitions, entities, or anything external.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import count

import msgspec
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from rampart.files.reading import FileError, check_size, plain_line, shown
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

MAX_ELEMENTS = 200_000
MAX_DEPTH = 10_000
"""Nesting of XML elements beyond which a file is refused."""

MAX_CONTAINERS = 50
"""Fault trees and components in each other: names in them are looked up level by level."""

MAX_NAME = 1000

_PATH_SHOWN = 300
"""Characters of a path beyond which nothing is added to it."""

_ASIDE = frozenset({"label", "attributes"})
_DEFINITIONS = {"define-gate": "gate", "define-basic-event": "basic-event",
                "define-house-event": "house-event"}
_UNSUPPORTED = {
    "define-CCF-group": "common-cause groups would change the cut sets",
    "define-substitution": "substitutions would change the cut sets",
    "include": "other files are not read",
}


_Path = tuple[str, ...]


class OpenPsaError(ValueError):
    """A file that cannot be read. The message is one line: file, path, what is wrong."""

    def __init__(self, file: str, path: str, problem: str) -> None:
        super().__init__(plain_line(f"{file}: {path}: {problem}"))


class _BoundedBuilder(ET.TreeBuilder):
    """Makes elements of XML until there are too many, or one lies too deep."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = self._count = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ET.Element:
        """Open an element."""
        self._depth += 1
        self._count += 1
        if self._depth > MAX_DEPTH:
            raise FileError(f"elements are nested more than {MAX_DEPTH} deep; name the inner "
                            "formulas as gates")
        if self._count > MAX_ELEMENTS:
            raise FileError(f"more than {MAX_ELEMENTS} elements")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ET.Element:
        """Close an element."""
        self._depth -= 1
        return super().end(tag)


class _Definition(msgspec.Struct, frozen=True):
    """A definition, before names are resolved."""

    kind: str
    path: str
    place: _Path
    private: bool
    element: ET.Element

    @property
    def name(self) -> str:
        """Unique among all definitions."""
        return ".".join(self.place) if self.private else self.place[-1]


def read_open_psa(text: str | bytes, file: str, top: str = "") -> Formula:
    """Read a fault tree.

    Args:
        text: XML.
        file: Name to use in messages.
        top: Name of the top gate; "" for the only gate that no other one uses.

    Raises:
        OpenPsaError: The text is no XML, or no MEF, or makes no sense.
    """
    try:
        check_size(text, MAX_BYTES)
        parser = DefusedXMLParser(target=_BoundedBuilder(), forbid_dtd=True, forbid_entities=True,
                                  forbid_external=True)
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
    return _Reader(root, file).formula(top)


class _Reader:
    """Reads one document."""

    def __init__(self, root: ET.Element, file: str) -> None:
        self._error = partial(OpenPsaError, file)
        self._definitions: dict[_Path, _Definition] = {}
        self._public: dict[str, _Definition] = {}
        self._gates: dict[str, Connective] = {}
        self._basic: set[str] = set()
        self._house: dict[str, bool] = {}
        for definition in self._find(root):
            name = definition.place[-1]
            earlier = self._definitions.get(definition.place) or (
                None if definition.private else self._public.get(name))
            # An event may be used in a fault tree and given its probability in the model data.
            if earlier is not None:
                raise self._error(definition.path,
                                  f"duplicate name {name!r}, already defined at {earlier.path}")
            self._definitions[definition.place] = definition
            if not definition.private:
                self._public[name] = definition

    # -- definitions ----------------------------------------------------------------------------

    def _find(self, root: ET.Element) -> Iterator[_Definition]:
        stack: list[tuple[ET.Element, str, _Path, bool]] = [(root, "/opsa-mef", (), False)]
        while stack:
            parent, path, place, private = stack.pop()
            inner = []
            counts = Counter[str]()
            if len(place) > MAX_CONTAINERS:
                raise self._error(
                    path, f"more than {MAX_CONTAINERS} fault trees and components in each other")
            for element in parent:
                tag = element.tag
                counts[tag] += 1
                name = element.get("name", "")
                here = f"{path}/{tag}[{f'@name={shown(name)}' if name else counts[tag]}]"
                if tag in _UNSUPPORTED:
                    raise self._error(here, f"not supported: {_UNSUPPORTED[tag]}")
                role = element.get("role", "")
                hidden = role == "private" or (private and role != "public")
                if tag in {"define-fault-tree", "define-component", "model-data"}:
                    below = place if tag == "model-data" else (*place, self._checked(name, here))
                    inner.append((element, here, below, hidden))
                elif tag in _DEFINITIONS:
                    yield _Definition(_DEFINITIONS[tag], here,
                                      (*place, self._checked(name, here)), hidden, element)
            stack.extend(reversed(inner))

    def _checked(self, name: str, path: str) -> str:
        if not name or "." in name:
            raise self._error(path, f"name {shown(name)}: expected a name without dots")
        if len(name) > MAX_NAME:
            raise self._error(path, f"name {shown(name)}: expected at most {MAX_NAME} characters")
        return name

    # -- formulas -------------------------------------------------------------------------------

    def formula(self, top: str) -> Formula:
        """Return the formula of all definitions."""
        for definition in self._definitions.values():
            if definition.kind == "gate":
                self._define_gate(definition)
            elif definition.kind == "house-event":
                constant = definition.element.find("constant")
                self._house[definition.name] = (
                    constant is not None and self._truth(constant, definition.path))
            else:
                self._basic.add(definition.name)
        if top and top not in self._gates:
            raise self._error("/opsa-mef", f"unknown top gate {top!r}; known: "
                                           f"{first_few(self._gates)}")
        try:
            return Formula(self._gates, frozenset(self._basic), self._house, top)
        except FormulaError as error:
            raise self._error("/opsa-mef", str(error)) from None

    def _truth(self, constant: ET.Element, path: str) -> bool:
        value = constant.get("value", "")
        if value not in {"true", "false"}:
            raise self._error(f"{path}/constant", f"value {value!r}: expected 'true' or 'false'")
        return value == "true"

    def _define_gate(self, definition: _Definition) -> None:
        bodies = [child for child in definition.element if child.tag not in _ASIDE]
        if len(bodies) != 1:
            raise self._error(definition.path, f"{len(bodies)} formulas; a gate has exactly one")
        name = definition.name
        pending = [(name, bodies[0], definition.path)]
        place = definition.place[:-1]
        numbers = count(1)
        while pending:  # nested formulas become gates named after the one they are in
            own, body, path = pending.pop()
            here = f"{path}/{body.tag}" if len(path) < _PATH_SHOWN else f"{path[:_PATH_SHOWN]}..."
            if body.tag in REFERENCES:
                self._gates[own] = Connective((self._refer(body, place, here),), 1, 1)
            elif body.tag == "constant":
                self._house[f"{own}{GENERATED}constant"] = self._truth(body, path)
                self._gates[own] = Connective((f"{own}{GENERATED}constant",), 1, 1)
            elif body.tag in CONNECTIVES:
                inputs = []
                for child in body:
                    if child.tag in REFERENCES:
                        inputs.append(self._refer(child, place, here))
                    elif child.tag not in _ASIDE:
                        nested = f"{name}{GENERATED}{next(numbers)}"
                        pending.append((nested, child, here))
                        inputs.append(nested)
                self._gates[own] = self._connective(own, body, inputs, here)
            else:
                raise self._error(
                    here[:200], f"unknown connective; known: {', '.join(CONNECTIVES)}")

    def _refer(self, element: ET.Element, place: _Path, path: str) -> str:
        name = element.get("name", "")
        here = f"{path}/{element.tag}[@name={shown(name)}]"
        found = self._resolve(name, place)
        kind = element.get("type", "") if element.tag == "event" else element.tag
        if found is None:
            if kind in {"", "basic-event"} and name and "." not in name:
                self._basic.add(name)  # MEF lets basic events be declared by their use
                return name
            raise self._error(here, f"there is no {kind or 'event'} {name!r}")
        if kind and kind != found.kind:
            raise self._error(here, f"{name!r} is a {found.kind}, not a {kind}")
        return found.name

    def _resolve(self, name: str, place: _Path) -> _Definition | None:
        """Look a name up: in the innermost container first, then outwards, then in public."""
        parts = tuple(name.split("."))
        candidates = ((*place[:depth], *parts) for depth in range(len(place), -1, -1))
        return next((self._definitions[candidate] for candidate in candidates
                     if candidate in self._definitions), self._public.get(name))

    def _connective(self, name: str, element: ET.Element, inputs: list[str], path: str
                    ) -> Connective:
        tag, count = element.tag, len(inputs)
        if not count:
            raise self._error(path, "empty gate; it needs inputs")
        if count != _TAKES.get(tag, count):
            raise self._error(path, f"{count} inputs; {tag!r} takes {_TAKES[tag]}")
        low, high = 1, count
        match tag:
            case "atleast":
                low = self._number(element, "min", count, path)
            case "cardinality":
                low = self._number(element, "min", count, path)
                high = self._number(element, "max", count, path)
                if low > high:
                    raise self._error(path, f"min = {low} is more than max = {high}")
            case "imply":
                self._gates[f"{name}{GENERATED}not"] = Connective((inputs[0],), 1, 1, negated=True)
                inputs = [f"{name}{GENERATED}not", inputs[1]]
            case "xor" | "iff":
                high = 1
            case "and" | "nand":
                low = count
        return Connective(tuple(inputs), low, high, negated=tag in _NEGATED)

    def _number(self, element: ET.Element, attribute: str, count: int, path: str) -> int:
        text = element.get(attribute, "")
        least = 1 if element.tag == "atleast" else 0
        if not text.isdecimal() or len(text) > 9 or not least <= int(text) <= count:
            raise self._error(path, f"{attribute} = {text!r}: expected a number from {least} to "
                                    f"{count}, the inputs")
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
            gate = ET.SubElement(
                element, kind, {"min": str(event.required)} if kind == "atleast" else {})
            for entry in event.of:
                ET.SubElement(gate, "gate" if entry in gates else "basic-event", name=entry)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
