"""`rampart node log`: the last lines of a log, then what is added to it."""

from __future__ import annotations

from collections import deque

from rampart.cli.operate.node_verbs import tail


def test_the_last_lines_are_of_both_files(tmp_path):
    file = tmp_path / "a.log"
    file.write_text("3\n4\n")
    assert list(tail(file, 10, lambda: False)) == ["3", "4"]
    (tmp_path / "a.log.1").write_text("1\n2\n")
    assert list(tail(file, 3, lambda: False)) == ["2", "3", "4"]
    assert list(tail(file, 0, lambda: False)) == []


def test_what_would_harm_a_terminal_is_shown_as_what_it_is(tmp_path):
    file = tmp_path / "a.log"
    file.write_bytes(b"\x1b[2J\tclear\xff\r\n")
    assert list(tail(file, 1, lambda: False)) == [r"\u001b[2J" + "\tclear\ufffd"]


def test_it_follows_into_the_next_file(tmp_path):
    file = tmp_path / "a.log"
    file.write_text("1\n")
    steps = deque([
        lambda: None, lambda: file.write_text("1\n2\n"),
        lambda: file.rename(tmp_path / "a.log.1"), lambda: file.write_text("3\n"),
        lambda: None, lambda: None])

    def follows() -> bool:
        if steps:
            steps.popleft()()
        return bool(steps)

    assert list(tail(file, 5, follows)) == ["1", "2", "3"]
