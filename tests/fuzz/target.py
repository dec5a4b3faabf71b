"""Targets of fuzzing: a decoder, its documented errors, and samples of its input.

A target is a function of bytes with a decorator, in a module that `test_decoders` imports:

    @target("greeting", refuses=(ValueError,), samples=lambda: [b"hello"])
    def greeting(data: bytes) -> None:
        decode_greeting(data)

For any input it raises nothing but `refuses`, within `LIMIT_S` and `LIMIT_BYTES`.

Inputs are samples with a few changes, which know the formats: numbers become extreme, nesting deep,
pieces repeated. Documents change as trees.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import resource
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import tomli_w
from hypothesis import strategies as st

from rampart.files import toml
from tests import ROOT

CORPUS = Path(__file__).with_name("corpus")
LAST = ROOT / ".hypothesis" / "inputs"
"""The last input of each target. After a failure, it is the smallest that fails."""

LIMIT_S = 2.0
"""Processor time of one input, or of one message to an actor."""

LIMIT_BYTES = 500 << 20
MAX_LINE = 2000

Run = Callable[[bytes], object]


class SlowError(Exception):
    """An input takes more than `LIMIT_S`."""


class UnsoundError(Exception):
    """The text of a documented error is not one printable line."""


def restart_limit() -> None:
    """Start `LIMIT_S` again."""
    signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT_S)
    signal.setitimer(signal.ITIMER_PROF, 5 * LIMIT_S)


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """Limit the processor time and the memory of what runs inside.

    SIGPROF ends the process if a library does not return to Python.

    Raises:
        SlowError: after `LIMIT_S`.
        MemoryError: beyond `LIMIT_BYTES` more than before.
    """
    late: list[SlowError] = []

    def stop(*_: Any) -> None:
        late.append(SlowError(f"more than {LIMIT_S:g} s of processor time"))
        raise late[0]

    pages = int(Path("/proc/self/statm").read_text("ascii").split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGVTALRM, stop)
    restart_limit()
    resource.setrlimit(resource.RLIMIT_AS,
                       (pages * resource.getpagesize() + LIMIT_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGVTALRM, handler)
        if late:  # the decoder may have caught it
            raise late[0]


@dataclass(frozen=True)
class Target:
    """A decoder to be fuzzed.

    Attributes:
        name: of the target, and of the folder of its corpus.
        run: decodes an input.
        refuses: its documented errors.
        samples: returns inputs that it accepts, from which others are made.
        form: of its input, for `inputs`: text, binary, json, msgpack or toml.
        words: of its language.
        one_line: whether the text of its errors is one printable line.
    """

    name: str
    run: Run
    refuses: tuple[type[Exception], ...]
    samples: Callable[[], Sequence[bytes]]
    form: str
    words: tuple[str, ...]
    one_line: bool

    def corpus(self) -> list[Path]:
        """Return the inputs that once were findings."""
        return sorted((CORPUS / self.name).glob("*"))

    def try_input(self, data: bytes) -> bool:
        """Run one input within the limits; return whether it is accepted.

        Raises:
            Exception: a finding.
        """
        LAST.mkdir(parents=True, exist_ok=True)
        (LAST / self.name).write_bytes(data)
        try:
            with limits():
                self.run(data)
        except self.refuses as error:
            text = str(error)
            if self.one_line and not (text.isprintable() and len(text) <= MAX_LINE):
                raise UnsoundError(f"not a printable line: {text[:200]!r}") from error
            return False
        return True


ALL: dict[str, Target] = {}


def target(name: str, *, refuses: tuple[type[Exception], ...],
           samples: Callable[[], Sequence[bytes]], form: str = "binary",
           words: Sequence[str] = (), one_line: bool = False) -> Callable[[Run], Run]:
    """Register a function of bytes as a target; see `Target` for the arguments."""

    def register(run: Run) -> Run:
        ALL[name] = Target(name, run, refuses, samples, form, tuple(words), one_line)
        return run

    return register


MAX_INPUT = 1 << 16
"""Bytes of an input."""

Draw = Callable[[st.SearchStrategy[Any]], Any]
Change = Callable[[Draw, bytes, bytes], bytes]

_NUMBERS = (0, -1, 1, 255, 256, 65536, 2**31, 2**32 - 1, 2**53 + 1, 2**63 - 1, 2**63, 2**64 - 1,
            -2**63, 0.0, -0.0, 0.5, 1e-9, 1e-320, 1e17, 1e300, math.nan, math.inf, -math.inf)
_TEXTS = ("", " ", "\0", "\n", "\x1b[2J", "a", "..", "../../x", "/dev/zero", "1e999", "é🛬",
          "\u202e", "x" * 300, "x" * 20_000, "{name}", "%s", "🛬" * 100)
_WRITTEN = [f"{number!r}".encode() for number in _NUMBERS] + [
    b"9" * 400, b"9" * 5000, b"1e400", b"0x" + b"f" * 40, b"1_000", b"true", b"''", b"[]", b"{}",
    b"null", b'"\\ud800"', b"--"]
_BRACKETS = (b"[", b"{", b"(", b"<a>", b'"', b"'", b'"""', b"{a=", b'{"a":', b"not ", b"a.")
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_PACKED = [number.to_bytes(size, order) for number in (0, 1, 255) for size in (1, 2, 4, 8)
           for order in ("little", "big")] + [b"\xff" * size for size in (2, 4, 8)]
_VALUES = st.one_of(
    st.sampled_from(_NUMBERS), st.sampled_from(_TEXTS), st.text(max_size=8), st.integers(),
    st.floats(), st.sampled_from(([], {}, None, True, [1, 2], {"a": 1}, b"", [[]])))


@st.composite
def inputs(draw: Draw, pool: Sequence[bytes], form: str, words: Sequence[str] = ()) -> bytes:
    """Return an input of a pool with up to four changes, or any bytes."""
    ways = [_piece]
    if form in _APART:
        ways += [_whole(form)] * 4
    if form in {"text", "toml", "json"}:
        ways += [_text([word.encode() for word in words])] * 3
    if draw(st.integers(0, 20)) == 20:
        return draw(st.binary(max_size=200))
    data = draw(st.sampled_from(pool))
    for change in draw(st.lists(st.sampled_from(ways), max_size=4)):
        data = change(draw, data, draw(st.sampled_from(pool)))[:MAX_INPUT]
    return data


def _piece(draw: Draw, data: bytes, other: bytes) -> bytes:
    """Replace a piece by nothing, by itself repeated, or by other bytes."""
    start = draw(st.integers(0, len(data)))
    end = start + draw(st.sampled_from((0, 1, 2, 4, 8, 30, len(data))))
    piece = draw(st.one_of(st.binary(max_size=8), st.sampled_from(_PACKED),
                           st.sampled_from((data[start:end], other[start:end]))))
    return data[:start] + piece * draw(st.sampled_from((1, 0, 2, 300))) + data[end:]


def _text(words: Sequence[bytes]) -> Change:
    """Replace a number by an extreme one, or insert a word or many brackets."""

    def changed(draw: Draw, data: bytes, _other: bytes) -> bytes:
        numbers = [found.span() for found in _NUMBER.finditer(data)]
        if numbers and draw(st.booleans()):
            start, end = draw(st.sampled_from(numbers))
            return data[:start] + draw(st.sampled_from(_WRITTEN)) + data[end:]
        at = draw(st.integers(0, len(data)))
        if words and draw(st.booleans()):
            new = draw(st.sampled_from(words))
        else:
            new = draw(st.sampled_from(_BRACKETS)) * draw(st.sampled_from((1, 2, 40, 1100, 20_000)))
        return data[:at] + new + data[at:]

    return changed


def _whole(form: str) -> Change:
    """Take a document apart, change one of its parts, and put it together again."""

    def changed(draw: Draw, data: bytes, other: bytes) -> bytes:
        try:
            parts, others = _APART[form](data), _APART[form](other)
        except Exception:  # damaged by an earlier change
            return _piece(draw, data, other)
        try:
            return _TOGETHER[form](_tree(draw, parts, others))
        except Exception:  # the format has no such value
            return data

    return changed


def _tree(draw: Draw, value: Any, other: Any) -> Any:
    """Change one place in nested dictionaries and lists."""
    root = [value]
    holder, key = draw(st.sampled_from(_places(root)))
    match draw(st.sampled_from(("value", "other", "remove", "repeat", "nest", "rename"))):
        case "value":
            holder[key] = draw(_VALUES)
        case "other":
            there, name = draw(st.sampled_from(_places([other])))
            holder[key] = there[name]
        case "remove" if holder is not root:
            del holder[key]
        case "repeat" if isinstance(holder, list) and holder is not root:
            holder[key:key] = [holder[key]] * draw(st.sampled_from((1, 3, 100, 2000)))
        case "nest":
            outer = draw(st.sampled_from((lambda inner: [inner], lambda inner: {"a": inner})))
            for _ in range(draw(st.sampled_from((1, 5, 40, 600)))):
                holder[key] = outer(holder[key])
        case "rename" if isinstance(holder, dict):
            holder[draw(st.sampled_from((*_TEXTS, *map(str, holder))))] = holder.pop(key)
    return root[0]


def _places(root: list[Any]) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    left: list[Any] = [root]
    while left and len(found) < 2000:
        holder = left.pop()
        for key in (holder if isinstance(holder, dict) else range(len(holder))):
            found.append((holder, key))
            if isinstance(holder[key], (dict, list)):
                left.append(holder[key])
    return found


_APART: dict[str, Callable[[bytes], Any]] = {
    "json": json.loads, "toml": lambda data: toml.parse(data.decode()),
    "msgpack": msgspec.msgpack.decode}
_TOGETHER: dict[str, Callable[[Any], bytes]] = {
    "json": lambda value: json.dumps(value).encode(),
    "toml": lambda value: tomli_w.dumps(value).encode(),
    "msgpack": msgspec.msgpack.encode}
