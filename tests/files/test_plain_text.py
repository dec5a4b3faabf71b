"""Nothing that comes from the bus moves a cursor, forges a line or floods a console."""

from __future__ import annotations

import io
import json

import pytest
from msgspec import convert, inspect
from rich.console import Console as RichConsole

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Header
from rampart.cli.look import top
from rampart.cli.look.topic_verbs import in_line
from rampart.cli.osmosis.lines import OsmosisLines
from rampart.cli.output import print_json, print_table, say, say_text, warn
from rampart.cli.run_picture import DECODED, RunPicture
from rampart.files.plain_text import one_line, printable
from rampart.files.streams import complain
from rampart.sim.osmosis.trial.mission_trial import MissionConsole
from rampart.sim.runs.console import LINES_PER_S, REPORTS_PER_S
from tests.fuzz.message_extremes import TEXTS, all_topics, filled

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
    assert (len(lines), lines[-1]) == (REPORTS_PER_S + 1, "[   1.00 s] news")
    assert max(map(len, lines)) < 500
    now[0] = 1.0
    console.take(topics.POSE, m.Pose(0.0, 0.0, 0.0), Header("x", 1, 1, 2.0))
    assert stream.getvalue().splitlines()[-1] == (
        f"[   2.00 s] {10_000 - REPORTS_PER_S} more lines were left out")


def test_a_flood_of_other_news_does_not_hide_that_the_robot_is_unsafe():
    stream = io.StringIO()
    console = MissionConsole(stream, lambda: 0.0)
    for number in range(1000):
        console.line(0.0, f"{number}")
    truth = m.GroundTruth(m.Pose(0.0, 0.0, 0.0), m.Twist(0.0, 0.0), 1, 0.0, 0.0, 0.0, 1.0)
    console.take(topics.TRUTH, truth, Header("simulator", 1, 1, 3.0))
    lines = stream.getvalue().splitlines()
    assert (len(lines), lines[-1]) == (LINES_PER_S + 1, "[   3.00 s] UNSAFE:  1 collisions")
