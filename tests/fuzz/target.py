"""What is fuzzed: a decoder, what it may raise, and inputs that it reads.

A new target is a function of bytes with a decorator, in a module that `fuzz.targets` imports:

    @target("greeting", refuses=(ValueError,), samples=lambda: [b"hello"])
    def greeting(data: bytes) -> None:
        decode_greeting(data)

It must raise nothing but `refuses`, for any input, within `LIMIT_S` of processor time and
`LIMIT_BYTES` of memory on top of what the process had.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests import ROOT

CORPUS = Path(__file__).with_name("corpus")

LIMIT_S = 2.0
LIMIT_BYTES = 500 << 20
MAX_INPUT = 1 << 16
"""Bytes of an input."""

MAX_LINE = 2000
_VALUES = re.compile(r"\d+|'[^']*'|`[^`]*`|\"[^\"]*\"|/\S+")

Run = Callable[[bytes], object]


@dataclass(frozen=True)
class Target:
    """A decoder to be fuzzed.

    Attributes:
        name: of the target, and of the folder of its corpus.
        run: hands it an input.
        refuses: what it is documented to raise.
        samples: returns inputs that it reads, from which others are made.
        kind: of its format, for `mutate`: text, binary, json, msgpack, toml, png or mcap.
        words: of its language.
        says_one_line: the text of what it raises is one printable line.
        suite_runs: inputs that the ordinary suite makes anew.
    """

    name: str
    run: Run
    refuses: tuple[type[Exception], ...]
    samples: Callable[[], Sequence[bytes]]
    kind: str
    words: tuple[str, ...]
    says_one_line: bool
    suite_runs: int

    @property
    def folder(self) -> Path:
        """Where inputs are kept that have found something once."""
        return CORPUS / self.name

    def corpus(self) -> list[bytes]:
        """Return what was found once."""
        return [path.read_bytes() for path in sorted(self.folder.glob("*"))]

    def outcome(self, data: bytes) -> str:
        """Run one input and return in short what came of it.

        Raises:
            Exception: whatever it raises that it must not.
        """
        try:
            self.run(data)
        except self.refuses as error:
            text = str(error)
            if self.says_one_line and not (text.isprintable() and len(text) <= MAX_LINE):
                raise UnsoundError(f"no printable line: {text[:200]!r}") from error
            return f"{type(error).__name__}: {_VALUES.sub('#', text)[:120]}"
        return "read"


class UnsoundError(Exception):
    """A decoder refused as it may, and what it said is not what it promises."""


ALL: dict[str, Target] = {}


def target(name: str, *, refuses: tuple[type[Exception], ...],
           samples: Callable[[], Sequence[bytes]], kind: str = "binary",
           words: Sequence[str] = (), says_one_line: bool = False,
           suite_runs: int = 300) -> Callable[[Run], Run]:
    """Register a function of bytes as a target; see `Target` for the arguments."""

    def register(run: Run) -> Run:
        if name in ALL:
            raise ValueError(f"two targets of the name {name}")
        ALL[name] = Target(name, run, refuses, samples, kind, tuple(words), says_one_line,
                           suite_runs)
        return run

    return register


def place_of(error: BaseException) -> str:
    """Return what was raised and where, the last places in this project: the same for one cause."""
    cause = error.__cause__ if isinstance(error, UnsoundError) else error
    frames = [frame for frame in traceback.extract_tb(cause.__traceback__ if cause else None)
              if frame.filename.startswith(str(ROOT)) and "/.venv/" not in frame.filename
              and "/tests/fuzz/" not in frame.filename]
    places = [f"{Path(frame.filename).relative_to(ROOT)}:{frame.lineno}" for frame in frames[-2:]]
    return f"{type(error).__name__} at {' < '.join(reversed(places))}"
