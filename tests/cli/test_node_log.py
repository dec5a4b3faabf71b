"""`rampart node log`: the last lines of a log."""

from types import SimpleNamespace

from rampart.actors.foreign.program import LOGS
from rampart.cli.main import main
from rampart.cli.operate import node_verbs


def test_the_last_lines_are_of_both_files_and_harm_no_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(node_verbs, "find_run", lambda _port: SimpleNamespace(
        folder=str(tmp_path), nodes=("wheels", "driver")))
    (tmp_path / LOGS).mkdir()
    file = tmp_path / LOGS / "wheels.log"
    file.write_bytes(b"3\n\x1b[2J\tclear\xff\r\n")
    (tmp_path / LOGS / "wheels.log.1").write_text("1\n2\n")
    assert main(["node", "log", "wheels", "--lines", "3"]) == 0
    assert capsys.readouterr().out == "2\n3\n\\u001b[2J\tclear\ufffd\n"
    assert main(["node", "log", "driver"]) == 1
    assert capsys.readouterr().err.endswith("nodes with output: wheels\n")
    assert main(["node", "log", "wheel"]) == 2
