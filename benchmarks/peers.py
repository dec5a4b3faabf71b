"""The same node killed under dora-rs, supervisord, circus, a loop, and Rampart, in rounds.

Each keeper runs the same program, `peer_node.py`, with the same interpreter; Rampart also runs the
same work as an actor. This process publishes the input at 20 Hz, receives every output, checks the
mean, and takes the time from kill(2) to the first output of another process. Each round kills once
under each keeper, so a slow moment of the machine affects all. `make bench-peers` installs the
peers into `.venv-peers`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import msgspec
import zenoh

from benchmarks.restarts import in_words, spread
from benchmarks.systems import INPUT_HZ, OUTPUT, is_mean, peers_system, scan
from rampart.actors.bus.topic import ROOT
from rampart.actors.bus.zenoh_session import session_config
from rampart.cli.output import print_json, print_table, progress
from rampart.testing import RealRun

os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])  # for the actors
NODE = Path(__file__).with_name("peer_node.py")
START_S, BACK_S, CALM_S = 60.0, 20.0, 0.5
ACTOR, COMMAND = "Rampart, actor", "Rampart, command"

_LOOP = "import subprocess, sys\nwhile True: subprocess.run(sys.argv[1:])"


def loop(_folder: Path, node: list[str], _program: str) -> list[str]:
    """Return what starts a loop around the node."""
    return [sys.executable, "-I", "-S", "-c", _LOOP, *node]


def supervisord(folder: Path, node: list[str], program: str) -> list[str]:
    """Configure supervisord; it restarts in the next turn of its loop, a second later."""
    file = folder / "supervisord.conf"
    file.write_text(f"""[supervisord]
nodaemon = true
logfile = /dev/null
logfile_maxbytes = 0
pidfile = {folder}/pid
[program:node]
command = {shlex.join(node)}
autorestart = true
startsecs = 0
stdout_logfile = NONE
stderr_logfile = NONE
stopsignal = KILL
""", encoding="utf-8")
    return [program, "-c", str(file)]


def circus(folder: Path, node: list[str], program: str) -> list[str]:
    """Configure circus to look every 0.1 s, not every 5 s."""
    file = folder / "circus.ini"
    file.write_text(f"""[circus]
check_delay = 0.1
endpoint = ipc://{folder}/endpoint
pubsub_endpoint = ipc://{folder}/pubsub
[watcher:node]
cmd = {shlex.join(node)}
copy_env = True
graceful_timeout = 0.5
""", encoding="utf-8")
    return [program, str(file)]


def dora(folder: Path, node: list[str], program: str) -> list[str]:
    """Configure dora without a limit of restarts."""
    file = folder / "dataflow.yml"
    file.write_text(json.dumps({"nodes": [{
        "id": "node", "path": node[0], "args": " ".join(node[1:]), "restart_policy": "always",
        "max_restarts": 0}]}), encoding="utf-8")  # JSON is YAML
    return [program, "run", str(file)]


PEERS = {"dora-rs": ("dora-rs-cli", "dora", dora),
         "supervisord": ("supervisor", "supervisord", supervisord),
         "circus": ("circus", "circusd", circus),
         "loop": ("", "", loop)}
"""Title → package, program, configuration."""


class Outputs:
    """The newest process of each keeper's node; called on Zenoh's threads."""

    def __init__(self) -> None:
        self._newest: dict[str, tuple[int, float, float]] = {}  # pid, begun, received
        self._news = threading.Condition()

    def take(self, keeper: str, pid: int, begun_s: float, first: float, mean: float) -> None:
        """Take an output; a wrong mean does not count."""
        at_s = time.monotonic()
        with self._news:
            if is_mean(first, mean) and self._newest.get(keeper, (0,))[0] != pid:
                self._newest[keeper] = pid, begun_s, at_s
                self._news.notify_all()

    def wait(self, keeper: str, other_than: int, within_s: float
             ) -> tuple[int, float, float] | None:
        """Return pid, begin and time of the first output of another process; None if none came."""
        with self._news:
            self._news.wait_for(lambda: self._newest.get(keeper, (other_than,))[0] != other_than,
                                within_s)
            found = self._newest.get(keeper)
        return found if found and found[0] != other_than else None


@contextlib.contextmanager
def running(command: list[str], folder: Path) -> Iterator[None]:
    """Run a keeper; at the end it and its node are killed."""
    with subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                          stderr=subprocess.DEVNULL, start_new_session=True) as process:
        try:
            yield
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(3)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def start(keepers: contextlib.ExitStack, chosen: list[str], installed: Path, folder: Path,
          outputs: Outputs) -> dict[str, str]:
    """Start bus, keepers and Rampart; return the title of each keeper that runs its node."""
    endpoint = f"unixsock-stream/{folder}/bus"
    session = keepers.enter_context(zenoh.open(session_config([endpoint], ())))

    def of_program(sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).rpartition("/")[2]
        outputs.take(name, *json.loads(sample.payload.to_bytes()))

    session.declare_subscriber("bench/output/*", of_program)
    source = session.declare_publisher("bench/input", express=True)
    over = threading.Event()

    def publish() -> None:
        number = 0
        while not over.wait(1 / INPUT_HZ):
            number += 1
            source.put(scan(number))

    threading.Thread(target=publish, daemon=True).start()
    keepers.callback(over.set)
    titles = {}
    for title in (one for one in chosen if one in PEERS):
        package, program, configure = PEERS[title]
        binary = installed.resolve() / "bin" / program
        if program and not binary.is_file():
            print(f"{title}: not installed: make bench-peers", file=sys.stderr)
            continue
        site = next(installed.glob("lib/python*/site-packages"), installed)
        versions = [d.version for d in metadata.distributions(name=package, path=[str(site)])]
        of_it = folder / title
        of_it.mkdir()
        node = [sys.executable, "-P", str(NODE), title, endpoint]
        keepers.enter_context(running(configure(of_it, node, str(binary)), of_it))
        titles[title] = " ".join((title, *versions[:1])) if package else title
    if ACTOR in chosen or COMMAND in chosen:
        file = folder / "peers.toml"
        file.write_text(peers_system([sys.executable, "-P", str(NODE), COMMAND, endpoint]))
        run = keepers.enter_context(RealRun(folder, file))
        run.wait_until(lambda: run.pid("actor") is not None, START_S, "the actor did not start")
        ours = keepers.enter_context(zenoh.open(session_config((), run.info.endpoints)))
        decode = msgspec.msgpack.Decoder(tuple[str, int, int, float, OUTPUT.type]).decode

        def of_actor(sample: zenoh.Sample) -> None:
            body = decode(sample.payload.to_bytes())[4]
            outputs.take(ACTOR, body.pid, body.begun_s, body.first, body.mean)

        ours.declare_subscriber(f"{ROOT}/{OUTPUT.key}", of_actor)
        titles |= {title: title for title in (ACTOR, COMMAND) if title in chosen}
    return titles


def main() -> int:
    """Kill in rounds, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    keepers = [*PEERS, ACTOR, COMMAND]
    parser.add_argument("--kills", type=int, default=12, metavar="N", help="under each keeper")
    parser.add_argument("--keeper", action="append", choices=keepers, help="only this one")
    parser.add_argument("--peers-in", type=Path, default=Path(".venv-peers"), metavar="DIR")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    outputs = Outputs()
    begun: dict[str, list[float]] = {}
    back: dict[str, list[float]] = {}
    failed: list[str] = []
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as all_of_them, \
            progress() as show:
        show("starting")
        titles = start(all_of_them, options.keeper or keepers, options.peers_in, Path(folder),
                       outputs)
        newest = {}
        for keeper in titles:
            show(f"waiting for {keeper}")
            newest[keeper] = outputs.wait(keeper, 0, START_S)
        for number in range(options.kills):
            for keeper in titles:
                known = newest[keeper]
                if known is None:
                    continue
                show(f"round {number + 1} of {options.kills}: {keeper}")
                time.sleep(CALM_S + random.uniform(0, 1 / INPUT_HZ))  # out of step with the input
                killed_s = time.monotonic()
                os.kill(known[0], signal.SIGKILL)
                newest[keeper] = found = outputs.wait(keeper, known[0], BACK_S)
                if found is not None:
                    begun.setdefault(keeper, []).append(round((found[1] - killed_s) * 1e3, 2))
                    back.setdefault(keeper, []).append(round((found[2] - killed_s) * 1e3, 2))
    failed = [keeper for keeper in titles if newest[keeper] is None]
    times = {keeper: [a / b for a, b in zip(of, back.get(ACTOR, []), strict=False)]
             for keeper, of in back.items()}
    if options.json:
        print_json([{"keeper": titles[keeper], "begun_ms": begun[keeper], "output_ms": back[keeper],
                     "begun": spread(begun[keeper]), "output": spread(back[keeper]),
                     "times_actor": spread(times[keeper])} for keeper in back])
    else:
        print_table(("kept by", "begun, ms", "output, ms (5 to 95 %)", "times Rampart's actor"), [
            (titles[keeper], in_words(begun[keeper]), in_words(back[keeper]),
             in_words(times[keeper])) for keeper in back])
    for keeper in failed:
        print(f"{keeper}: its node did not come back within {BACK_S:g} s", file=sys.stderr)
    return 1 if failed or len(titles) < len(options.keeper or keepers) else 0


if __name__ == "__main__":
    sys.exit(main())
