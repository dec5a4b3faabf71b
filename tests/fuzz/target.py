"""Targets of fuzzing: a decoder, its documented errors, and samples of its input.

A target is a function of bytes with a decorator, in a module that `test_decoders` imports:

    @target("greeting", refuses=(ValueError,), samples=lambda: [b"hello"])
    def greeting(data: bytes) -> None:
        decode_greeting(data)

For any input it raises nothing but `refuses`, within `LIMIT_S` and `LIMIT_BYTES`.
"""

from __future__ import annotations

import contextlib
import resource
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
