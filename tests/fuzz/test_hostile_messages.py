"""Messages from the bus: no flood of them, and no text of them, does harm.

No flood of names makes an actor, or what shows a run, remember more than it has room for. Nothing
moves a cursor, forges a line or floods a console.
"""

from __future__ import annotations

import asyncio
import io
import json
import types
from collections import deque
from itertools import count

import msgspec
import pytest
from msgspec import convert, inspect
from rich.console import Console as RichConsole

import rampart.sim.osmosis.trial.mission_trial
import rampart.sim.osmosis.trial.record
import rampart.sim.runs.record
from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import STRANGERS, ArrivalGuard, Header, encode
from rampart.actors.bus.limits import REPORTS_PER_S
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.views import OsmosisViews
from rampart.actors.runtime.actor import Actor, Context
from rampart.actors.runtime.injection import MAX_DELAYED, MAX_IN_FORCE
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.cli.look import top
from rampart.cli.look.topic_verbs import in_line
from rampart.cli.osmosis.lines import OsmosisLines
from rampart.cli.output import print_json, print_table, say, say_text, warn
from rampart.cli.run_picture import DECODED, RunPicture
from rampart.files.plain_text import one_line, printable
from rampart.files.streams import complain
from rampart.sim.osmosis.trial.mission_trial import MissionConsole, MissionTrial
from rampart.sim.runs.console import LINES_PER_S
from rampart.sim.runs.console import REPORTS_PER_S as CONSOLE_REPORTS_PER_S
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualClock
from rampart.testing import VirtualSystem, run
from tests.fuzz.message_extremes import TEXTS, all_topics, filled
from tests.fuzz.test_handler_fuzz import Machine, cases, system

FLOOD = 700
"""Messages of each topic, each about other names and half of them from another source."""

ROOM = 600
"""More than this nothing may hold after it."""

_FOREIGN = (Context, VirtualBus, Hub, VirtualClock, type, types.ModuleType, types.FunctionType,
            types.MethodType, asyncio.AbstractEventLoop, asyncio.Future, Machine)


# -- every actor --------------------------------------------------------------------------------


def holdings(root):
    """Yield path and size of every collection that can be reached from an object."""
    seen, todo = set(), deque([("", root)])
    while todo:
        path, held = todo.popleft()
        if id(held) in seen or isinstance(held, _FOREIGN):
            continue
        seen.add(id(held))
        if isinstance(held, dict):
            yield path, len(held)
            todo.extend((f"{path}[]", part) for part in held.values())
        elif isinstance(held, list | set | frozenset | tuple | deque):
            yield path, len(held)
            todo.extend((f"{path}[]", part) for part in held)
        elif isinstance(held, msgspec.Struct):
            todo.extend((f"{path}.{name}", getattr(held, name)) for name in held.__struct_fields__)
        else:
            names = [*getattr(held, "__dict__", ()), *(
                name for kind in type(held).__mro__ for name in getattr(kind, "__slots__", ()))]
            todo.extend((f"{path}.{name}", getattr(held, name)) for name in names
                        if hasattr(held, name))


def flooded(of, name):
    """Return an actor of a system that was told of `FLOOD` names on each of its topics."""

    async def scenario():
        async with VirtualSystem(of.run, of.layout, keeps_checkpoints=True) as living:
            actor = living.start_node(name, *([Machine()] if name == SUPERVISOR else []))
            await asyncio.sleep(1.0)
            sequence = count(1)
            for topic in actor.inputs():
                kind = inspect.type_info(topic.type)
                names = actor.names(topic, name, actor.parameters) or ()
                for number in range(FLOOD):
                    source = f"s{number}" if number % 2 else "osmosis_control"
                    member_of = names[number % len(names)] if names else f"n{number}"
                    living.bus.publish(
                        topic, topic.at(member_of) if topic.is_family else topic.at(),
                        msgspec.msgpack.encode(
                            (source, 1, next(sequence), 0.9, filled(kind, f"n{number}", number))))
                    if number % 100 == 0:
                        await asyncio.sleep(0.02)
            await asyncio.sleep(0.1)
            sizes = [(path, size) for path, size in holdings(actor) if size > ROOM]
            await living.stop(name)
            return sizes

    return run(scenario)


def kinds():
    found = {}
    for of, name in cases():
        if of == "osmosis":
            found.setdefault(system(of).layout.members[name].actor, name)
    return sorted(found.values())


@pytest.mark.parametrize("name", kinds())
def test_no_actor_remembers_more_names_than_it_has_room_for(name):
    assert flooded(system("osmosis"), name) == []


# -- what shows and records ---------------------------------------------------------------------


def test_what_shows_and_records_a_run_remembers_a_bounded_number_of_names(monkeypatch):
    monkeypatch.setattr(rampart.sim.osmosis.trial.record, "KEPT", 500)
    monkeypatch.setattr(rampart.sim.runs.record, "KEPT", 500)
    monkeypatch.setattr(rampart.sim.osmosis.trial.record, "TRACK_KEPT", 500)
    monkeypatch.setattr(rampart.sim.osmosis.trial.mission_trial, "MOST", 500)
    of = system("osmosis")
    run = MissionTrial(of.run, 60.0, io.StringIO())
    picture, views = RunPicture(OsmosisLines()), OsmosisViews()
    clock = type("Clock", (), {"now": staticmethod(lambda: 0.0)})()
    for topic in all_topics():
        kind = inspect.type_info(topic.type)
        for number in range(5000 if topic in views.translators else 1500):
            header = Header(f"s{number}", 1, 1, 0.0)
            body = msgspec.convert(filled(kind, f"n{number}", number), topic.type,
                                   builtin_types=(bytes,))
            for sink in run.sinks(clock) if number < FLOOD else ():
                sink(topic, body, header)
            if topic in (*DECODED, *OsmosisLines.read):
                picture.heard(topic, header, body, 0.0)
            views.of(topic, topic.at(f"n{number}") if topic.is_family else topic.at(), header,
                     body, 0)
    assert [found for found in holdings(run) if found[1] > ROOM
            and "airport" not in found[0] and "_known_lights" not in found[0]] == []
    assert [found for found in holdings(picture) if found[1] > 1025] == []
    assert [found for found in holdings(views) if found[1] > 4096] == []
    record = run.conclude(0.0, "the end")
    assert "were not kept" in record.events[-1].text


# -- the parts ----------------------------------------------------------------------------------


def test_a_flood_of_strangers_does_not_bring_a_superseded_node_back():
    taken, refused, crowded = [], [], []
    guard = ArrivalGuard(lambda: 0.0, {"localization"}, lambda: crowded.append(1))
    receive = guard.receiver(ftm_topics.RESET, lambda _key, message: taken.append(message.source),
                             lambda _key, reason: refused.append(reason))

    def say(source, incarnation, sequence):
        receive("k", encode(Header(source, incarnation, sequence, 0.0), fm.Reset("RM1", "")))

    say("localization", 2, 1)
    for number in range(3 * STRANGERS):
        say(f"s{number}", 1, 1)
    say("localization", 1, 9)
    say("localization", 2, 1)
    assert refused == ["incarnation 1 of localization was superseded by 2"]
    assert len(taken) == 1 + 3 * STRANGERS
    assert len(crowded) == 2 * STRANGERS


def during(kind, act, seconds=1.5):
    """Let an actor live while `act(actor, stranger)` is done to it; return what it reported."""

    async def scenario():
        async with VirtualSystem() as living:
            living.members = frozenset({"node", "friend"})
            sent = living.overhear("node")
            actor = living.start("node", kind)
            await asyncio.sleep(0.1)
            act(actor, living.bus)
            await asyncio.sleep(seconds)
            await living.stop("node")
            return [body for key, body in sent if key == "diagnostic/node"]

    return run(scenario)


class Quiet(Actor):
    """Publishes when it is told to."""

    outputs = (topics.POSE,)


def test_a_node_with_too_much_to_report_says_how_much_it_left_out():
    reports = during(Quiet, lambda actor, _: [
        actor.report_diagnostic("c", "r", f"o{n}") for n in range(1000)])
    assert len(reports) == REPORTS_PER_S + 1
    assert reports[-1]["reason"] == f"{1000 - REPORTS_PER_S} more reports were left out"


def test_a_crowd_of_sources_is_reported_once_a_second():
    def crowd(_actor, stranger):
        for number in range(2 * STRANGERS):
            stranger.publish(bus_topics.INJECT, bus_topics.INJECT.at(),
                             encode(Header(f"s{number}", 1, 1, 0.0), order(number)))

    reports = during(Quiet, crowd)
    assert [(report["context"], report["count"]) for report in reports] == [("many sources", 1)]


def order(number):
    return bm.Injection(f"i{number}", topics.POSE.key, "delay", 1e6, delay_s=1e6)


def test_injections_of_one_node_are_bounded_and_so_is_what_they_hold_back():
    def act(actor, _):
        for number in range(MAX_IN_FORCE + 5):
            actor._injections.order(order(number), topics.POSE)
        assert len(actor._injections.gate.in_force) == MAX_IN_FORCE
        for _ in range(MAX_DELAYED + 100):
            actor.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0))
        assert len(actor._timers) <= MAX_DELAYED + MAX_IN_FORCE

    reports = during(Quiet, act, seconds=0.1)
    assert any("one was dropped" in report["reason"] for report in reports)


HOSTILE = ("\x1b[2J\x1b]0;owned\x07", "a\nb", "a\r\x1b[1A[   0.00 s] UNSAFE: forged", "\x9b31m",
           "\u202edrawkcab", "\u2028", "\x00", "\x7f", "\U000e0041", "\u2066")


class Terminal(io.StringIO):
    """A terminal that only remembers what it was sent."""

    def isatty(self) -> bool:
        return True


def harmless(sent: str) -> bool:
    """Whether nothing was sent but printable lines, and the live line's own way back."""
    return all(c.isprintable() or c == "\n" for c in sent.replace("\r\x1b[K", ""))


@pytest.mark.parametrize(("text", "shown"), [
    ("plain", "plain"), ("Übergröße 🤖", "Übergröße 🤖"), ("\x1b[2J", "\\u001b[2J"),
    ("a\nb", "a\\u000ab"), ("\x9b", "\\u009b"), ("\u202e", "\\u202e"),
    ("\U000e0041", "\\udb40\\udc41")])
def test_an_unprintable_character_is_written_as_its_number(text, shown):
    assert printable(text) == shown
    assert json.loads(f'"{shown}"') == text


def test_one_line_is_one_line_and_not_too_long():
    assert one_line(" a \n\t b\x1b ") == "a b\\u001b"
    assert one_line("x" * 1000, 10) == "xxx ... xx"
    assert one_line("Flughafen Zürich: 滑走路") == "Flughafen Zürich: 滑走路"
    assert printable("a\nb\x1b", keep="\n") == "a\nb\\u001b"


@pytest.mark.parametrize("text", HOSTILE)
def test_output_of_tools_is_harmless_for_any_text(text, capsys):
    say(f"{text} said")
    say_text(f"{text}")
    warn(text)
    print_table(("node",), [(text,)])
    print_json({"by": text})
    say(in_line(fm.Reset(text, text)))
    complain(text)
    out, err = capsys.readouterr()
    assert harmless(out + err)
    *_, end, reset = [line for line in out.splitlines() if line]
    assert (json.loads(reset), end) == ({"recovery": text, "by": text}, "}")


@pytest.mark.parametrize("topic", all_topics(), ids=lambda t: t.key)
def test_a_console_shows_control_characters_without_obeying_them(topic):
    stream = Terminal()
    console = MissionConsole(stream)
    picture = RunPicture(OsmosisLines())
    for number, text in enumerate((*HOSTILE, *TEXTS)):
        body = convert(filled(inspect.type_info(topic.type), text, number), topic.type,
                       builtin_types=(bytes,))
        header = Header(text[:200], 1, number, float(number))
        console.take(topic, body, header)
        if topic in (*DECODED, *OsmosisLines.read):
            picture.heard(topic, header, body, 0.0)
    console.close()
    assert harmless(stream.getvalue())
    screen = RichConsole(file=io.StringIO(), width=100, no_color=True)
    screen.print(top.screen(top.Frame("x", 7450, 1.0, 0.0, picture), 100))
    assert harmless(screen.file.getvalue())


def report(number):
    return bm.Diagnostic("x" * 200, "c" * 2000, "r" * 2000, f"{number}", 1)


def test_a_flood_of_reports_is_some_clipped_lines_and_a_count_and_other_news_come_through():
    stream, now = io.StringIO(), [0.0]
    console = MissionConsole(stream, lambda: now[0])
    for number in range(10_000):
        console.take(bus_topics.DIAGNOSTIC, report(number), Header("x", 1, number, 1.0))
    console.line(1.0, "news")
    lines = stream.getvalue().splitlines()
    assert (len(lines), lines[-1]) == (CONSOLE_REPORTS_PER_S + 1, "[   1.00 s] news")
    assert max(map(len, lines)) < 500
    now[0] = 1.0
    console.take(topics.POSE, m.Pose(0.0, 0.0, 0.0), Header("x", 1, 1, 2.0))
    assert stream.getvalue().splitlines()[-1] == (
        f"[   2.00 s] {10_000 - CONSOLE_REPORTS_PER_S} more lines were left out")


def test_a_flood_of_other_news_does_not_hide_that_the_robot_is_unsafe():
    stream = io.StringIO()
    console = MissionConsole(stream, lambda: 0.0)
    for number in range(1000):
        console.line(0.0, f"{number}")
    truth = m.GroundTruth(m.Pose(0.0, 0.0, 0.0), m.Twist(0.0, 0.0), 1, 0.0, 0.0, 0.0, 1.0)
    console.take(topics.TRUTH, truth, Header("simulator", 1, 1, 3.0))
    lines = stream.getvalue().splitlines()
    assert (len(lines), lines[-1]) == (LINES_PER_S + 1, "[   3.00 s] UNSAFE:  1 collisions")
