"""Logical gates over the names of detection and recovery modules.

A mechanism joins detection modules to recovery modules by two gates (paper, section V, "logical
gates"): `detect = "DM1 and DM3"`, `recover = "RM2 and RM4"`. The language is

    DM1                      DM1 and DM3               DM1 or (DM2 and not DM3)
    2 of (DM1, DM2, DM3)     RM2 and RM4               RM4 or RM3

`and` binds tighter than `or`, `not` tighter than both. In a recovery gate `and` runs both
together. `or` runs the first alternative, and the next one if that has failed or lacks what it
needs. `not` and `k of` are not allowed there.

A silent detection module counts as active, so `DM1` holds. Its silence does not prove that all is
well either, so `not DM1` holds too.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Collection, Iterator, Mapping
from functools import lru_cache, reduce
from itertools import chain, combinations, product
from operator import and_, or_

import msgspec

from rampart.files.plain_text import one_line

MAX_NAMES = 16
"""Of a gate; a gate over more modules belongs in the fault tree."""

MAX_TOKENS = 400
"""Names, words, commas and parentheses of a gate; this bounds its depth and its inputs as well."""

WORDS = frozenset({"and", "or", "not", "of"})
"""Reserved words of the language."""

MAX_WAYS = 64
"""Alternatives of a recovery gate: `(A or B) and (C or D)` has four."""


class GateError(ValueError):
    """A gate cannot be read, or is useless. The message is one line."""

    def __init__(self, problem: str) -> None:
        super().__init__(one_line(problem))


class Gate(msgspec.Struct, frozen=True):
    """A gate: a name, its negation, or at least `required` of some inputs.

    Attributes:
        name: Name of a module; "" for a gate over inputs.
        negated: The module must not be active.
        required: How many inputs must hold.
        inputs: Inputs of the gate.
    """

    name: str = ""
    negated: bool = False
    required: int = 0
    inputs: tuple[Gate, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the gate, each once, in the sequence of the text."""
        if self.name:
            return (self.name,)
        return tuple(dict.fromkeys(chain.from_iterable(i.names for i in self.inputs)))

    def holds(self, active: Collection[str], silent: Collection[str] = ()) -> bool:
        """Return whether the gate holds if these modules are active (`silent` ones included)."""
        if self.name:
            if self.negated:
                return self.name not in active or self.name in silent
            return self.name in active
        return sum(gate.holds(active, silent) for gate in self.inputs) >= self.required

    def renamed(self, words: Mapping[str, str]) -> Gate:
        """Return the gate with names replaced by the given words, if there are any."""
        return Gate(words.get(self.name) or self.name, self.negated, self.required,
                    tuple(gate.renamed(words) for gate in self.inputs))

    def alternatives(self) -> Iterator[tuple[str, ...]]:
        """Yield the sets of names that satisfy a gate without negation, the preferred one first."""
        if self.name:
            yield (self.name,)
            return
        for chosen in combinations(self.inputs, self.required):
            for ways in product(*(gate.alternatives() for gate in chosen)):
                yield tuple(dict.fromkeys(chain.from_iterable(ways)))

    def __str__(self) -> str:
        if self.name:
            return f"not {self.name}" if self.negated else self.name
        inner = [str(i) if i.name or 1 < i.required < len(i.inputs) else f"({i})"
                 for i in self.inputs]
        if self.required == 1:
            return " or ".join(inner)
        if self.required == len(self.inputs):
            return " and ".join(inner)
        return f"{self.required} of ({', '.join(map(str, self.inputs))})"


@lru_cache(maxsize=4096)
def detection_gate(text: str) -> Gate:
    """Read the gate on the detection side of a mechanism.

    Raises:
        GateError: It cannot be read, can never be active, or is active when nothing is wrong.
    """
    gate = _read(text)
    names = gate.names
    if len(names) > MAX_NAMES:
        raise GateError(f"{len(names)} detection modules; expected at most {MAX_NAMES}, more "
                        "belong in the fault tree")
    if gate.holds(()):
        raise GateError("active while all its detection modules are idle; expected idle then")
    if not _truth_table(gate, names):
        raise GateError("can never be active")
    return gate


@lru_cache(maxsize=4096)
def recovery_gate(text: str) -> Gate:
    """Read the gate on the recovery side of a mechanism.

    Raises:
        GateError: It cannot be read, or has more in it than names, `and` and `or`.
    """
    gate = _read(text)
    names = gate.names
    if len(names) > MAX_NAMES:
        raise GateError(f"{len(names)} recovery modules; expected at most {MAX_NAMES}")
    ways = _count_ways(gate)
    if ways > MAX_WAYS:
        raise GateError(f"{ways} alternatives; expected at most {MAX_WAYS}")
    return gate


def _truth_table(gate: Gate, names: tuple[str, ...]) -> int:
    """Return the sets of active names for which a gate holds: one bit for each of the 2^n sets."""
    sets = 1 << len(names)
    every = (1 << sets) - 1
    # Of name k: 2^k sets without it, 2^k sets with it, and so on.
    with_name = {name: every // ((1 << (2 << k)) - 1) * ((1 << (1 << k)) - 1) << (1 << k)
                 for k, name in enumerate(names)}

    def table(part: Gate) -> int:
        if part.name:
            return every & ~with_name[part.name] if part.negated else with_name[part.name]
        tables = [table(inner) for inner in part.inputs]
        if part.required in {1, len(tables)}:
            return reduce(or_ if part.required == 1 else and_, tables)
        at_least = [every] + [0] * part.required  # of the inputs so far
        for holds in tables:
            for count in range(part.required, 0, -1):
                at_least[count] |= at_least[count - 1] & holds
        return at_least[-1]

    return table(gate)


def _count_ways(gate: Gate) -> int:
    """Return the number of alternatives without making them: there may be millions."""
    if gate.negated:
        raise GateError(f"'not {gate.name}' cannot be run; expected names, 'and' and 'or'")
    if gate.name:
        return 1
    if 1 < gate.required < len(gate.inputs):
        raise GateError(f"'{gate.required} of' is ambiguous here; expected names, 'and' and 'or'")
    counts = [_count_ways(i) for i in gate.inputs]
    return sum(counts) if gate.required == 1 else math.prod(counts)


_TOKEN = re.compile(r"\w+|[(),]", re.ASCII)
_STRANGE = re.compile(r"[^\w\s(),]", re.ASCII)
_NAME = re.compile(r"\b[A-Za-z]\w*", re.ASCII)
_AT_LEAST = re.compile(r"\b([0-9]+)\s+of\s*\(")
_MAX_DIGITS = 9
_LANGUAGE = ("expected names, 'and', 'or', 'not', 'k of (...)' and parentheses, e.g. "
             "'DM1 and not DM2' or '2 of (DM1, DM2, DM3)'")


def _read(text: str) -> Gate:
    """Parse a gate as Python, with `n` before each name, and `2 of (` as `k2(`."""
    tokens = len(_TOKEN.findall(text))
    if tokens > MAX_TOKENS:
        raise GateError(f"{tokens} names, words and parentheses; expected at most {MAX_TOKENS}, "
                        "more belong in the fault tree")
    spelt = _NAME.sub(lambda found: found[0] if found[0] in WORDS else f"n{found[0]}",
                      " ".join(text.split()))
    try:
        if _STRANGE.search(text):
            raise SyntaxError
        return _gate(ast.parse(_AT_LEAST.sub(r"k\1(", spelt), mode="eval").body)
    except (SyntaxError, MemoryError):  # too many nested parentheses for Python
        raise GateError(_LANGUAGE) from None


def _gate(part: ast.expr) -> Gate:
    match part:
        case ast.Name(id=name) if name.startswith("n"):
            return Gate(name=name[1:])
        case ast.UnaryOp(op=ast.Not(), operand=inner):
            return _negate(_gate(inner))
        case ast.BoolOp(op=op, values=parts):
            return Gate(required=1 if isinstance(op, ast.Or) else len(parts),
                        inputs=tuple(map(_gate, parts)))
        case ast.Call(func=ast.Name(id=name), args=parts) if name.startswith("k"):
            required, count = int(name[1:1 + _MAX_DIGITS]), len(parts)
            if not 1 <= required <= count:
                raise GateError(f"{required} of {count} inputs; expected 1 to {count}")
            return Gate(required=required, inputs=tuple(map(_gate, parts)))
    raise SyntaxError


def _negate(gate: Gate) -> Gate:
    """Push a negation down to the names (De Morgan; not k-of-n is (n-k+1)-of-n of negations)."""
    if gate.name:
        return Gate(name=gate.name, negated=not gate.negated)
    return Gate(required=len(gate.inputs) - gate.required + 1,
                inputs=tuple(_negate(i) for i in gate.inputs))
