"""Who hears when a replacement works: a process of its own that prints what it hears, and when.

    observer.py bus ENDPOINT
    observer.py system PORT [--first KEY]... [--changes KEY]...

On a bus it is the router, publishes the input, and hears the output of the peers' nodes. In a
Rampart system it is a client of the routers like any tool. A line of JSON is a `Heard`; `at_s` is
the monotonic clock, which all processes of a machine share. It ends when its stdin closes.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import zenoh

from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.bus.run_info import find_run
from rampart.actors.bus.topic import ROOT
from rampart.actors.bus.zenoh_bus import PATIENCE_S
from rampart.actors.bus.zenoh_session import Credentials, session_config
from rampart.cli.bench.actors import INPUT_HZ, OUTPUT, is_mean, scan
from rampart.cli.session import tools_credentials

_LOOK_S = 0.05


class Heard(msgspec.Struct, frozen=True):
    """Something that was heard for the first time.

    Attributes:
        at_s: When, by the monotonic clock.
        key: Of the topic; below the root of a system's topics.
        source: Who published it.
        number: Its incarnation, or its process where there are none.
        body: What it said.
    """

    at_s: float
    key: str
    source: str
    number: int
    body: Any = None


class Observer:
    """Prints what is heard for the first time; called on Zenoh's threads."""

    def __init__(self) -> None:
        self._known: set[tuple[str, str, int]] = set()
        self._last: dict[tuple[str, str], Any] = {}
        self._lock = threading.Lock()

    def say(self, what: bytes) -> None:
        """Print a line, in one piece: several threads do."""
        with self._lock:
            sys.stdout.buffer.write(what + b"\n")
            sys.stdout.buffer.flush()

    def first(self, heard: Heard) -> None:
        """Print it if nothing of this incarnation was heard on this key before."""
        which = heard.key, heard.source, heard.number
        if which not in self._known:  # one key is heard on one thread at a time
            self._known.add(which)
            self.say(msgspec.json.encode(heard))

    def change(self, heard: Heard) -> None:
        """Print it if it says something else than what came before it."""
        which = heard.key, heard.source
        if self._last.get(which) != heard.body:
            self._last[which] = heard.body
            self.say(msgspec.json.encode(heard))

    def output(self, sample: zenoh.Sample) -> None:
        """Take the output of a peer's node; a wrong one counts for nothing."""
        at_s = time.monotonic()
        name = str(sample.key_expr).rpartition("/")[2]
        pid, begun_s, first, mean = msgspec.json.decode(
            sample.payload.to_bytes(), type=tuple[int, float, float, float])
        if is_mean(first, mean):
            self.first(Heard(at_s, OUTPUT.key, name, pid, {"pid": pid, "begun_s": begun_s}))


def bus(observer: Observer, endpoint: str) -> None:
    """Be the bus of the peers' nodes, and publish their input until stdin closes."""
    with zenoh.open(session_config([endpoint], ())) as session:
        session.declare_subscriber("bench/output/*", observer.output)
        source = session.declare_publisher("bench/input", express=True)
        observer.say(b"ready")
        closed = _closed()
        number = 0
        while not closed.wait(1 / INPUT_HZ):
            number += 1
            source.put(scan(number))


def system(observer: Observer, port: int, first: list[str], changes: list[str]) -> None:
    """Hear topics of the Rampart system on a base port, until stdin closes."""
    decode = msgspec.msgpack.Decoder(tuple[str, int, int, float, msgspec.Raw]).decode

    def hear(key: str, tell: Callable[[Heard], None]) -> None:
        def arrived(sample: zenoh.Sample) -> None:
            at_s = time.monotonic()
            try:
                source, incarnation, _, _, body = decode(sample.payload.to_bytes())
            except UNREADABLE:
                return
            said = msgspec.msgpack.decode(body)
            if isinstance(said, dict) and "mean" in said \
                    and not is_mean(said["first"], said["mean"]):
                return
            where = str(sample.key_expr).removeprefix(f"{ROOT}/")
            tell(Heard(at_s, where, source, incarnation, said))

        session.declare_subscriber(f"{ROOT}/{key}", arrived)

    run = find_run(port)
    with joined(run.endpoints, tools_credentials(run)[0]) as session:
        for key in first:
            hear(key, observer.first)
        for key in changes:
            hear(key, observer.change)
        observer.say(b"ready")
        _closed().wait()


def joined(dial: Sequence[str], shown: Credentials | None = None) -> zenoh.Session:
    """Return the session of a client; on a busy machine a router may not answer at once.

    Raises:
        zenoh.ZError: none has answered for `PATIENCE_S`.
    """
    until_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return zenoh.open(session_config((), dial, shown))
        except zenoh.ZError:
            if time.monotonic() > until_s:
                raise
            time.sleep(_LOOK_S)


def _closed() -> threading.Event:
    """Return what is set when stdin closes: whoever has started this process is gone."""
    event = threading.Event()

    def read() -> None:
        sys.stdin.read()
        event.set()

    threading.Thread(target=read, daemon=True).start()
    return event


def main() -> None:
    """Hear what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("bus", "system"))
    parser.add_argument("where", metavar="ENDPOINT|PORT")
    parser.add_argument("--first", action="append", default=[], metavar="KEY")
    parser.add_argument("--changes", action="append", default=[], metavar="KEY")
    options = parser.parse_args()
    if options.what == "bus":
        bus(Observer(), options.where)
    else:
        system(Observer(), int(options.where), options.first, options.changes)


if __name__ == "__main__":
    main()
