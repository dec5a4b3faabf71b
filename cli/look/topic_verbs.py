"""`rampart topic`: the topics of a system and their messages.

List and print topics. KEY is a key as `rampart topic list` shows it. For
a family use detection/DM1 for one member, or 'detection/*' for all.

Examples:
  rampart topic list
  rampart topic echo KEY -n 3
  rampart topic info KEY
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import math
from collections.abc import AsyncIterator
from typing import Any

import msgspec

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.topic import ROOT
from rampart.actors.system.topics import system_topics
from rampart.cli import completion, systems
from rampart.cli.following import LOOK_S, is_over
from rampart.cli.look import topic_catalogue as catalogue
from rampart.cli.look.topic_catalogue import check_member, resolve, topics_for
from rampart.cli.output import NoEffectError, positive, print_json, print_rows, say, say_text, warn
from rampart.cli.session import Session, connect, pause
from rampart.cli.verbs import JSON, PORT, add_family, add_verb, either, flag, number, option, word
from rampart.files import streams

_SHOWN_BYTES = 24


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    topic = add_family(verbs, "topic", "list and print topics", __doc__)
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


def topic_list(options: argparse.Namespace) -> int:
    """Print all topics.

    List all topics with message type, quality of service, nominal rate and frame.

    Examples:
      rampart topic list
      rampart topic list osmosis --markdown > topics.md
    """
    spec = systems.at_hand(options.system)
    if options.markdown:
        say_text(catalogue.markdown(spec).rstrip("\n"))
        return 0
    table = catalogue.uses(spec)
    print_rows(("key", "message", "qos", "rate", "frame"),
               [(t.key, t.type.__name__, t.qos.value, catalogue.rate(t), t.frame)
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
    use = next(u for u in catalogue.uses(spec) if u.topic is topic)
    if options.json:
        print_json({**_describe(use),
                    "fields": [{"name": n, "type": t} for n, t in catalogue.fields(topic.type)]})
        return 0
    for name, text in (
            ("key", topic.key),
            ("message", f"{topic.type.__name__}: {catalogue.summary(topic.type)}"),
            *(("", f"  {field}: {kind}") for field, kind in catalogue.fields(topic.type)),
            ("about", topic.doc),
            ("qos", f"{topic.qos.value}, at the reader: {catalogue.MAILBOX[topic.qos]}"),
            ("rate", catalogue.rate(topic)), ("frame", topic.frame or "none"),
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


def _describe(use: catalogue.TopicUse) -> dict[str, Any]:
    topic = use.topic
    return {"key": topic.key, "message": topic.type.__name__, "qos": topic.qos.value,
            "rate_hz": topic.rate_hz, "frame": topic.frame, "mailbox": catalogue.MAILBOX[topic.qos],
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
