"""When a command counts as hung, and what it may tell its notify socket."""

from __future__ import annotations

import socket

import pytest

from rampart.actors.foreign.pulse import NotifySocket, Pulse, extension_s


def test_silence_counts_from_the_last_beat_and_what_it_says_itself_at_once():
    pulse = Pulse(timeout_s=0.5, first_s=5.0, look_s=0.2)
    pulse.beat()
    assert [pulse.is_well(n / 10) for n in range(8)] == [True] * 6 + [False] * 2
    pulse.beat()
    assert pulse.is_well(0.8)
    pulse.trigger()
    assert not pulse.is_well(0.8)


def test_the_first_beat_may_come_later():
    pulse = Pulse(timeout_s=0.5, first_s=5.0, look_s=0.2)
    assert [pulse.is_well(n / 10) for n in (0, 10, 20)] == [True] * 3
    wells = [pulse.is_well(2.0 + n / 10) for n in range(60)]
    assert wells[40]
    assert not wells[-1]


def test_time_in_which_the_node_itself_stood_still_does_not_count():
    pulse = Pulse(timeout_s=0.5, first_s=0.5, look_s=0.2)
    pulse.beat()
    assert pulse.is_well(0.0)
    assert pulse.is_well(60.0)
    assert pulse.is_well(60.1)
    assert not any(pulse.is_well(60.0 + n / 10) for n in range(5, 10))


@pytest.mark.parametrize("started", [False, True])
def test_it_may_ask_for_more_time_until_its_next_beat(started):
    pulse = Pulse(timeout_s=0.5, first_s=1.0, look_s=0.2)
    if started:
        pulse.beat()
    pulse.extend(3.0)
    wells = [pulse.is_well(n / 10) for n in range(40)]
    assert wells == [True] * 31 + [False] * 9
    pulse.beat()
    assert [pulse.is_well(4.0 + n / 10) for n in range(8)][-1] is False, "the usual time again"


def test_silence_does_not_count_while_a_carrier_is_down_and_starts_again_after_its_restart():
    pulse = Pulse(timeout_s=0.5, first_s=1.0, look_s=0.2, carriers=("gateway",))
    pulse.beat()
    pulse.note_process("gateway", "crashed")
    pulse.beat()  # which shows that it works, though its event was lost
    pulse.note_process("other", "crashed")
    assert [pulse.is_well(n / 10) for n in range(8)] == [True] * 6 + [False] * 2
    pulse.beat()
    for failure in ("wedged", "crashed", "given up"):
        pulse.note_process("gateway", failure)
    assert all(pulse.is_well(1.0 + n / 10) for n in range(50))
    pulse.restart()  # of the program
    assert all(pulse.is_well(6.0 + n / 10) for n in range(50))
    pulse.note_process("gateway", "respawned")
    wells = [pulse.is_well(11.0 + n / 10) for n in range(13)]
    assert wells[:10] == [True] * 10
    assert wells[-2:] == [False] * 2


def test_one_that_says_that_it_ends_has_to_end():
    pulse = Pulse(timeout_s=0.5, first_s=5.0, look_s=0.2)
    pulse.stopping()
    wells = []
    for n in range(10):
        pulse.beat()
        wells.append(pulse.is_well(n / 10))
    assert wells[:5] == [True] * 5
    assert not wells[-1]


@pytest.mark.parametrize(("text", "seconds"), [
    ("5000000", 5.0), ("0", 0.0), ("3600000001", 3600.0), ("9" * 6000, 3600.0),
    ("0" * 7000 + "1000000", 1.0), ("", None), ("-1", None), (" 1", None), ("1e6", None),
    ("1_000", None), ("nan", None), ("\u0663", None)])
def test_how_much_time_it_asks_for(text, seconds):
    assert extension_s(text) == seconds


def test_assignments_come_in_order_several_in_a_datagram_and_a_flood_in_parts():
    notify = NotifySocket("wheels", lambda *_: None)
    assert notify.name.startswith("@")
    assert notify.take() == []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as command:
        for said in (b"READY=1\nSTATUS=up", b"\xff", b"", b"WATCHDOG=1"):
            command.sendto(said, f"\0{notify.name[1:]}")
        assert notify.take() == ["READY=1", "STATUS=up", "\ufffd", "WATCHDOG=1"]
        for _ in range(8):
            command.sendto(b"WATCHDOG=1", f"\0{notify.name[1:]}")
    assert [len(notify.take(most=5)) for _ in range(2)] == [5, 3]
    notify.close()
