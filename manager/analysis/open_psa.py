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
from collections.abc import Iterator
from functools import partial
from itertools import count

import msgspec
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from rampart.files.reading import FileError, check_size, plain_line, shown
from rampart.manager.analysis.formula import GENERATED, Connective, Formula, FormulaError
from rampart.manager.spec.schema import SystemSpec

CONNECTIVES = ("and", "or", "not", "xor", "nand", "nor", "iff", "imply", "atleast", "cardinality")
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
    place: tuple[str, ...]
    private: bool
    element: ET.Element


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
        self._definitions: dict[tuple[str, ...], _Definition] = {}
        self._public: dict[str, tuple[str, ...]] = {}
        self._gates: dict[str, Connective] = {}
        self._basic: set[str] = set()
        self._house: dict[str, bool] = {}
        for definition in self._find(root):
            self._add(definition)
        self._names = {place: self._name(place) for place in self._definitions}

    # -- definitions ----------------------------------------------------------------------------

    def _find(self, root: ET.Element) -> Iterator[_Definition]:
        stack: list[tuple[ET.Element, str, tuple[str, ...], bool]] = [
            (root, "/opsa-mef", (), False)]
        while stack:
            parent, path, place, private = stack.pop()
            inner = []
            counts: dict[str, int] = {}
            if len(place) > MAX_CONTAINERS:
                raise self._error(
                    path, f"more than {MAX_CONTAINERS} fault trees and components in each other")
            for element in parent:
                tag = element.tag
                counts[tag] = counts.get(tag, 0) + 1
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

    def _add(self, definition: _Definition) -> None:
        place, name = definition.place, definition.place[-1]
        earlier = self._definitions.get(place) or (
            None if definition.private else self._definitions.get(self._public.get(name, ())))
        # An event may be used in a fault tree and given its probability in the model data.
        if earlier is not None:
            raise self._error(definition.path,
                              f"duplicate name {name!r}, already defined at {earlier.path}")
        self._definitions[place] = definition
        if not definition.private:
            self._public[name] = place

    def _name(self, place: tuple[str, ...]) -> str:
        return ".".join(place) if self._definitions[place].private else place[-1]

    # -- formulas -------------------------------------------------------------------------------

    def formula(self, top: str) -> Formula:
        """Return the formula of all definitions."""
        for place, definition in self._definitions.items():
            name = self._names[place]
            if definition.kind == "gate":
                self._define_gate(name, definition)
            elif definition.kind == "house-event":
                self._house[name] = self._constant(definition)
            else:
                self._basic.add(name)
        try:
            return Formula(self._gates, frozenset(self._basic), self._house,
                           self._resolved_top(top))
        except FormulaError as error:
            raise self._error("/opsa-mef", str(error)) from None

    def _resolved_top(self, top: str) -> str:
        if not top:
            return ""
        if top not in self._gates:
            known = ", ".join(sorted(self._gates)[:8])
            raise self._error("/opsa-mef", f"unknown top gate {top!r}; known: {known}"
                              + (", ..." if len(self._gates) > 8 else ""))
        return top

    def _constant(self, definition: _Definition) -> bool:
        constant = definition.element.find("constant")
        return constant is not None and self._truth(constant, definition.path)

    def _truth(self, constant: ET.Element, path: str) -> bool:
        value = constant.get("value", "")
        if value not in {"true", "false"}:
            raise self._error(f"{path}/constant", f"value {value!r}: expected 'true' or 'false'")
        return value == "true"

    def _define_gate(self, name: str, definition: _Definition) -> None:
        bodies = [child for child in definition.element if child.tag not in _ASIDE]
        if len(bodies) != 1:
            raise self._error(definition.path, f"{len(bodies)} formulas; a gate has exactly one")
        pending = [(name, bodies[0], definition.path)]
        place = definition.place[:-1]
        numbers = count(1)
        while pending:  # nested formulas become gates named after the one they are in
            own, body, path = pending.pop()
            here = f"{path}/{body.tag}" if len(path) < _PATH_SHOWN else f"{path[:_PATH_SHOWN]}..."
            if body.tag in REFERENCES:
                self._gates[own] = Connective((self._refer(body, place, here),), 1, 1)
                continue
            if body.tag == "constant":
                self._house[f"{own}{GENERATED}constant"] = self._truth(body, path)
                self._gates[own] = Connective((f"{own}{GENERATED}constant",), 1, 1)
                continue
            if body.tag not in CONNECTIVES:
                raise self._error(
                    here[:200], f"unknown connective; known: {', '.join(CONNECTIVES)}")
            inputs = []
            for child in body:
                if child.tag in REFERENCES:
                    inputs.append(self._refer(child, place, here))
                elif child.tag not in _ASIDE:
                    nested = f"{name}{GENERATED}{next(numbers)}"
                    pending.append((nested, child, here))
                    inputs.append(nested)
            self._gates[own] = self._connective(own, body, inputs, here)

    def _refer(self, element: ET.Element, place: tuple[str, ...], path: str) -> str:
        name = element.get("name", "")
        here = f"{path}/{element.tag}[@name={shown(name)}]"
        found = self._resolve(name, place)
        kind = element.get("type", "") if element.tag == "event" else element.tag
        if found is None:
            if kind in {"", "basic-event"} and name and "." not in name:
                self._basic.add(name)  # MEF lets basic events be declared by their use
                return name
            raise self._error(here, f"there is no {kind or 'event'} {name!r}")
        actual = self._definitions[found].kind
        if kind and kind != actual:
            raise self._error(here, f"{name!r} is a {actual}, not a {kind}")
        return self._names[found]

    def _resolve(self, name: str, place: tuple[str, ...]) -> tuple[str, ...] | None:
        """Look a name up: in the innermost container first, then outwards, then in public."""
        parts = tuple(name.split("."))
        for depth in range(len(place), -1, -1):
            candidate = (*place[:depth], *parts)
            if candidate in self._definitions:
                return candidate
        return self._public.get(name)

    def _connective(self, name: str, element: ET.Element, inputs: list[str], path: str
                    ) -> Connective:
        tag, count = element.tag, len(inputs)
        exactly = {"not": 1, "xor": 2, "iff": 2, "imply": 2}.get(tag, 0)
        if not count:
            raise self._error(path, "empty gate; it needs inputs")
        if exactly and count != exactly:
            raise self._error(path, f"{count} inputs; {tag!r} takes {exactly}")
        entries = tuple(inputs)
        match tag:
            case "atleast":
                return Connective(entries, self._number(element, "min", count, path), count)
            case "cardinality":
                low = self._number(element, "min", count, path)
                high = self._number(element, "max", count, path)
                if low > high:
                    raise self._error(path, f"min = {low} is more than max = {high}")
                return Connective(entries, low, high)
            case "imply":
                self._gates[f"{name}{GENERATED}not"] = Connective((entries[0],), 1, 1, negated=True)
                return Connective((f"{name}{GENERATED}not", entries[1]), 1, 2)
            case "xor" | "iff":
                return Connective(entries, 1, 1, negated=tag == "iff")
            case "and" | "nand":
                return Connective(entries, count, count, negated=tag == "nand")
            case _:
                return Connective(entries, 1, count, negated=tag in {"nor", "not"})

    def _number(self, element: ET.Element, attribute: str, count: int, path: str) -> int:
        text = element.get(attribute, "")
        if not text.isdecimal() or len(text) > 9 or int(text) > count or (
                attribute == "min" and int(text) == 0 and element.tag == "atleast"):
            raise self._error(path, f"{attribute} = {text!r}: expected a number from "
                              f"{1 if element.tag == 'atleast' else 0} to {count}, the inputs")
        return int(text)


def write_open_psa(spec: SystemSpec) -> str:
    """Return a system's fault tree as MEF.

    Titles become labels; on which events mechanisms are barriers becomes an attribute.
    """
    root = ET.Element("opsa-mef")
    tree = ET.SubElement(root, "define-fault-tree", name=spec.name)
    data = ET.SubElement(root, "model-data")
    barriers: dict[str, str] = {mechanism.event: mechanism.name for mechanism in spec.mechanisms}
    gates = {event.name for event in spec.events if event.required}
    for event in spec.events:
        inner = event.name in gates
        element = ET.SubElement(tree if inner else data,
                                "define-gate" if inner else "define-basic-event", name=event.name)
        if event.title:
            ET.SubElement(element, "label").text = event.title
        if event.name in barriers:
            attributes = ET.SubElement(element, "attributes")
            ET.SubElement(attributes, "attribute", name="barrier", value=barriers[event.name])
        if inner:
            if event.required == len(event.of):
                gate = ET.SubElement(element, "and")
            elif event.required == 1:
                gate = ET.SubElement(element, "or")
            else:
                gate = ET.SubElement(element, "atleast", min=str(event.required))
            for entry in event.of:
                ET.SubElement(gate, "gate" if entry in gates else "basic-event", name=entry)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
