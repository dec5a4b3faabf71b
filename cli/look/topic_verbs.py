"""`rampart topic`: the topics of a system and their messages.

List, print and measure topics. KEY is a key as `rampart topic list` shows it. For
a family use detection/DM1 for one member, or 'detection/*' for all.

Examples:
  rampart topic list
  rampart topic echo KEY -n 3
  rampart topic hz KEY
  rampart topic info KEY
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import math
from collections import deque
from collections.abc import AsyncIterator, Collection, Iterable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from rampart.actors.bus.bounds import MANY, MAX_PAYLOAD_BYTES
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.run_info import NoRunError, find_run
from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import BASE_INPUTS, BASE_OUTPUTS
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import heard, published
from rampart.actors.system.topics import declared_topics, find_topic, system_topics
from rampart.cli import completion, systems
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    positive,
    print_json,
    print_rows,
    rendered,
    say,
    say_text,
    unknown,
    warn,
)
from rampart.cli.session import LOOK_S, Session, connect, is_over, pause
from rampart.cli.verbs import JSON, PORT, add_family, add_verb, either, flag, number, option, word
from rampart.files import streams
from rampart.manager.spec.specification import SystemSpec

MAILBOX = {
    Qos.SENSOR: "latest wins",
    Qos.STATE: "latest wins",
    Qos.COMMAND: "queued, bounded",
}
"""How messages wait at their reader (see `rampart.actors.runtime.mailbox`)."""


class TopicUse(NamedTuple):
    """A topic with its publishers and readers."""

    topic: Topic[Any]
    publishers: tuple[str, ...]
    readers: tuple[str, ...]


def uses(spec: SystemSpec) -> list[TopicUse]:
    """Return all topics with their publishers and readers in a system.

    Raises:
        UsageError: an actor class does not exist, or declares an invalid topic.
    """
    members = Layout(RunPlan(system_file=spec.name), spec).members.values()
    inputs = {member.name: heard(member) for member in members}
    outputs = {member.name: published(member) for member in members}
    return [TopicUse(topic, _who(topic, BASE_OUTPUTS, outputs) or ("tools",),
                     _who(topic, BASE_INPUTS, inputs)) for topic in system_topics(spec)]


def resolve(key: str, known: Sequence[Topic[Any]]) -> tuple[Topic[Any], str]:
    """Return topic and full key expression of a key that a user has typed.

    A member of a family is `detection/DM1`; all are `detection/{name}` or `detection/*`. The
    leading `rampart/` may be left out.

    Args:
        key: the key.
        known: all topics of the system.

    Raises:
        UsageError: no topic has this key.
    """
    found = _match(key, known)
    if found is None:
        raise unknown("topic", key, (topic.key for topic in known))
    return found


def topics_for(key: str, port: int | None) -> tuple[Topic[Any], ...]:
    """Return the topics of the run's system, among which a key is looked for.

    The actors of a system are loaded only for a key that neither the engine nor its application
    declares. Without a run these are the topics of the shipped system, if it has the key. If the
    system of the run cannot be read here, they are the topics of the engine.

    Args:
        key: the key that the user has typed.
        port: base port of the run, if there are several.

    Raises:
        UsageError: there is no run, and the shipped system lacks the topic; or the system of the
            run, or one of its actors, cannot be loaded here, and the engine lacks the topic.
    """
    try:
        file = find_run(port).system_file
    except NoRunError as error:
        shipped = declared_topics(systems.load(None))
        if _match(key, shipped) is None:
            raise UsageError(str(error)) from None
        return shipped
    try:
        spec = systems.load(file)
        known = declared_topics(spec)
        return known if _match(key, known) is not None else system_topics(spec)
    except ValueError as error:
        if _match(key, topics.ALL) is None:
            raise UsageError(str(error)) from None
        return topics.ALL


def _match(key: str, known: Sequence[Topic[Any]]) -> tuple[Topic[Any], str] | None:
    short = key.removeprefix("/").removeprefix(f"{ROOT}/")
    topic = find_topic(short, known)
    if topic is not None:
        return topic, f"{ROOT}/{short}"
    return next(((topic, topic.pattern) for topic in known if topic.is_family
                 and short in (topic.key, topic.key.replace("{name}", "*"))), None)


def check_member(key: str, nodes: Collection[str]) -> None:
    """Check that the node in a key of the engine exists; members of other families may be others.

    Raises:
        UsageError: the node is unknown.
    """
    topic = find_topic(key, topics.ALL)
    if topic is not None and (member := topic.member(key)) and member not in nodes:
        raise unknown("node", member, nodes)


def fields(kind: type[msgspec.Struct]) -> list[tuple[str, str]]:
    """Return name and type of each field of a message, as text."""
    return [(f.name, _type_name(f.type)) for f in msgspec.structs.fields(kind)]


def markdown(spec: SystemSpec) -> str:
    """Return `topics.md`, the reference page of the topics."""
    table = uses(spec)
    return rendered(
        Path(__file__).with_name("topics.md.jinja"), spec=spec, table=table, root=ROOT,
        most_bytes=MAX_PAYLOAD_BYTES, mailbox=MAILBOX, rate=rate, summary=summary, fields=fields,
        kinds=_messages(use.topic for use in table)).rstrip() + "\n"


def _who(topic: Topic[Any], of_all: Collection[Topic[Any]],
         of_each: Mapping[str, Collection[str]]) -> tuple[str, ...]:
    if topic in of_all:
        return ("every node",)
    return tuple(name for name, those in of_each.items() if topic.key in those)


def rate(topic: Topic[Any]) -> str:
    """Return the nominal rate of a topic in words."""
    sent = f", sent every {topic.resend_s:g} s" if topic.resend_s else ""
    return f"{topic.rate_hz:g} Hz{sent}" if topic.rate_hz else "on event"


def _messages(used: Iterable[Topic[Any]]) -> list[type[msgspec.Struct]]:
    """Return the message types of topics and those nested in them, each once."""
    found: dict[type[msgspec.Struct], None] = {}

    def visit(kind: Any) -> None:
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            if kind not in found:
                found[kind] = None
                for f in msgspec.structs.fields(kind):
                    visit(f.type)
            return
        for part in getattr(kind, "__args__", ()):
            visit(part)

    for topic in used:
        visit(topic.type)
    return list(found)


def _limits(meta: msgspec.Meta) -> str:
    """Return the bounds of a field: least and greatest value, or greatest length."""
    if meta.max_length is not None:
        return f"{{<={meta.max_length}}}"
    least, most = ("" if bound is None else str(bound) if isinstance(bound, int) else f"{bound:g}"
                   for bound in (meta.ge, meta.le))
    return f"{{{least}..{most}}}"


def summary(kind: type[msgspec.Struct]) -> str:
    """Return the description of a message in one line."""
    return " ".join((kind.__doc__ or "").split())


def _type_name(kind: Any) -> str:
    if hasattr(kind, "__metadata__"):
        return _type_name(kind.__origin__) + "".join(map(_limits, kind.__metadata__))
    arguments = getattr(kind, "__args__", ())
    if not arguments:
        if isinstance(kind, type) and issubclass(kind, Enum):
            return " | ".join(f'"{member.value}"' for member in kind)
        return str(getattr(kind, "__name__", kind))
    inner = ", ".join("..." if a is Ellipsis else _type_name(a) for a in arguments)
    return f"{getattr(kind, '__origin__', kind).__name__}[{inner}]"


_SHOWN_BYTES = 24
_WINDOW = 500


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    topic = add_family(verbs, "topic", "list, print and measure topics", __doc__)
    key = option("key", metavar="KEY", completer=completion.topics, help="key of a topic")
    add_verb(topic, "list", "list all topics; needs no run", topic_list,
             systems.choice(default="that of the run, else osmosis"),
             either(JSON, flag("--markdown", "print the reference page of topics")))
    add_verb(topic, "info", "show the contract of one topic; needs no run", topic_info, key,
             word("--system", "FILE", "system file (default: that of the run, else osmosis)"),
             JSON)
    add_verb(topic, "echo", "print messages as they arrive", topic_echo, PORT, key,
             option("-n", "--count", type=int, metavar="N", help="end after N messages"),
             number("--duration", "S", "end after S real seconds"),
             flag("--json", "print one JSON object per line"))
    add_verb(topic, "hz", "measure the rate of a topic", topic_hz, PORT, key,
             number("--duration", "S", "end after S real seconds"))


def topic_list(options: argparse.Namespace) -> int:
    """Print all topics.

    List all topics with message type, quality of service, nominal rate and frame.

    Examples:
      rampart topic list
      rampart topic list osmosis --markdown > topics.md
    """
    spec = systems.at_hand(options.system)
    if options.markdown:
        say_text(markdown(spec).rstrip("\n"))
        return 0
    table = uses(spec)
    print_rows(("key", "message", "qos", "rate", "frame"),
               [(t.key, t.type.__name__, t.qos.value, rate(t), t.frame)
                for t in (use.topic for use in table)],
               [_describe(use) for use in table], as_json=options.json)
    return 0


def topic_info(options: argparse.Namespace) -> int:
    """Print the contract of one topic.

    Show message type, fields, quality of service, rate, publishers and readers of
    a topic.

    Examples:
      rampart topic info control/command
      rampart topic info detection/DM1
    """
    spec = systems.at_hand(options.system)
    topic, _ = resolve(options.key, system_topics(spec))
    use = next(u for u in uses(spec) if u.topic is topic)
    if options.json:
        print_json({**_describe(use),
                    "fields": [{"name": n, "type": t} for n, t in fields(topic.type)]})
        return 0
    for name, text in (
            ("key", topic.key),
            ("message", f"{topic.type.__name__}: {summary(topic.type)}"),
            *(("", f"  {field}: {kind}") for field, kind in fields(topic.type)),
            ("about", topic.doc),
            ("qos", f"{topic.qos.value}, at the reader: {MAILBOX[topic.qos]}"),
            ("rate", rate(topic)), ("frame", topic.frame or "none"),
            ("publishers", ", ".join(use.publishers) or "none"),
            ("readers", ", ".join(use.readers) or "none")):
        say(f"{name:<12}{text}")
    return 0


async def topic_echo(options: argparse.Namespace) -> int:
    """Print messages as they come.

    Print one line per message: stamp (simulated seconds), source#incarnation,
    key, message. A payload that does not decode is shown with the reason.

    Examples:
      rampart topic echo localization/pose
      rampart topic echo 'detection/*' --duration 5
      rampart topic echo plan/route -n 1 --json
    """
    positive("--count", options.count)
    positive("--duration", options.duration)
    topic, key = resolve(options.key, topics_for(options.key, options.port))
    done, seen = asyncio.Event(), itertools.count(1)

    def show(data: dict[str, Any], line: str) -> None:
        number = next(seen)
        if options.count and number >= options.count:
            done.set()
        if not options.count or number <= options.count:
            print_json(data, indent=False) if options.json else say(line)

    def heard(short: str, header: Header, body: Any) -> None:
        show({"key": short, "stamp": header.stamp, "source": header.source,
              "incarnation": header.incarnation, "sequence": header.sequence, "message": body},
             f"{header.stamp:.3f} {header.source}#{header.incarnation} {short} {in_line(body)}")

    def garbage(short: str, payload: bytes, reason: str) -> None:
        show({"key": short, "garbage": payload[:256].hex(), "bytes": len(payload),
              "reason": reason},
             f"garbage {short} {len(payload)} bytes, not a {topic.type.__name__}: {reason}; "
             f"{payload[:_SHOWN_BYTES]!r}")

    async with connect(options.port) as session:
        check_member(key.removeprefix(f"{ROOT}/"), session.run.nodes)
        session.listen(topic, heard, key, garbage)
        async for left in _while_it_runs(session, options.duration):
            if done.is_set():
                break
            await pause(done, min(LOOK_S, left))
    if next(seen) == 1:
        raise _nothing_came(options.key, options.duration)
    return 0


async def topic_hz(options: argparse.Namespace) -> int:
    """Measure rates.

    Print once a second how often messages arrive, in simulated time like the nominal
    rate, over the last 500 messages. The run or Ctrl-C ends it.

    Examples:
      rampart topic hz control/command
      rampart topic hz 'heartbeat/*' --duration 3
    """
    positive("--duration", options.duration)
    topic, key = resolve(options.key, topics_for(options.key, options.port))
    arrivals: Remembered[str, deque[float]] = Remembered(MANY)
    async with connect(options.port) as session:
        check_member(key.removeprefix(f"{ROOT}/"), session.run.nodes)

        def heard(short: str, _header: Header, _body: Any) -> None:
            if short not in arrivals:
                arrivals[short] = deque(maxlen=_WINDOW)
            arrivals[short].append(session.clock.now())

        session.listen(topic, heard, key)
        async for left in _while_it_runs(session, options.duration):
            await asyncio.sleep(min(1.0, left))
            for short, times in sorted(arrivals.items()):
                if times[-1] > times[0]:
                    say(f"{short}: {(len(times) - 1) / (times[-1] - times[0]):.2f} Hz")
    if not arrivals:
        raise _nothing_came(options.key, options.duration)
    return 0


async def _while_it_runs(session: Session, duration_s: float | None) -> AsyncIterator[float]:
    """Yield the real seconds that are left, until the end of time, run or reader."""
    loop = asyncio.get_running_loop()
    end = math.inf if duration_s is None else loop.time() + duration_s
    while (left := end - loop.time()) > 0 and not (is_over(session.run) or streams.lost()):
        yield left
    if is_over(session.run):
        warn(f"the run has ended: {session.run.title} (port {session.run.base_port})")


def _nothing_came(key: str, duration_s: float | None) -> NoEffectError:
    when = "before the run ended" if duration_s is None else f"within {duration_s:g} s"
    return NoEffectError(f"no message on {key} {when}")


def _describe(use: TopicUse) -> dict[str, Any]:
    topic = use.topic
    return {"key": topic.key, "message": topic.type.__name__, "qos": topic.qos.value,
            "rate_hz": topic.rate_hz, "frame": topic.frame, "mailbox": MAILBOX[topic.qos],
            "publishers": use.publishers, "readers": use.readers, "doc": topic.doc}


def in_line(body: Any) -> str:
    """Return a message as one line of JSON, with the length of bytes instead of the bytes."""
    plain = msgspec.to_builtins(body, builtin_types=(bytes,))

    def shorten(value: Any) -> Any:
        if isinstance(value, bytes):
            return f"<{len(value)} bytes>"
        if isinstance(value, dict):
            return {k: shorten(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [shorten(v) for v in value]
        return value

    return msgspec.json.encode(shorten(plain)).decode()
