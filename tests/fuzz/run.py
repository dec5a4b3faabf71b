"""Fuzz the decoders: random inputs, each under limits of time and memory; `make fuzz`.

Every target is run in processes of its own. Where atheris is installed (`pip install
'rampart-robot[fuzz]'`), libFuzzer chooses the inputs by the code that they reach; else our own
engine changes samples, and goes on from inputs with a new outcome. What is found is made smaller,
written to tests/fuzz/corpus/TARGET, and run by the ordinary suite from then on.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Lock

from tests import ROOT
from tests.fuzz import targets
from tests.fuzz.target import CORPUS, LIMIT_S, MAX_INPUT, Target
from tests.fuzz.worker import Board

RUNS = 100_000
MAX_DEATHS = 20
"""Of workers of one target: what kills so many is found already."""

STUCK_S = 300.0
"""Real seconds without an input run: not even the kernel's signal ended it."""

_LOOK_S = 0.2


@dataclass
class Result:
    """What came of one target."""

    target: str
    engine: str
    inputs: int = 0
    refused: int = 0
    kept: int = 0
    seconds: float = 0.0
    findings: list[dict[str, str]] = field(default_factory=list)


class Fuzzing:
    """Fuzzes one target.

    Args:
        target: which.
        engine: "guided" or "own".
        runs: how many inputs.
        seconds: real seconds after which it ends before; 0 for no end.
        seed: of all that is drawn.
        keep: where findings go.
        progress: told the result so far, now and then.
    """

    def __init__(self, target: Target, engine: str, *, runs: int, seconds: float, seed: int,
                 keep: Path, progress: Callable[[Result], None]) -> None:
        self._target = target
        self._runs = runs
        self._seconds = seconds
        self._seed = seed
        self._keep = keep
        self._progress = progress
        self.result = Result(target.name, engine)

    def run(self) -> Result:
        """Fuzz, and return what came of it."""
        began = time.monotonic()
        for death in range(MAX_DEATHS):
            with tempfile.TemporaryDirectory(prefix="rampart-fuzz-", dir=_memory()) as name:
                folder = Path(name)
                code, data = self._work(folder, self._seed + death, began)
                self._collect(folder)
            if code == 0:
                break
            if not data and self.result.inputs == 0:
                raise SystemExit(f"{self._target.name}: the worker does not start: "
                                 f"exit code {code}")
            if code is not None:
                self._found(_name_of(code), data)
                self.result.inputs += 1
            if code is None or self.result.inputs >= self._runs:
                break
        self.result.seconds = round(time.monotonic() - began, 1)
        return self.result

    def _work(self, folder: Path, seed: int, began: float) -> tuple[int | None, bytes]:
        """Run a worker; return its exit code, None if the time was over, and its last input."""
        result = self.result
        before_it = result.refused
        board = Board(folder / "board", MAX_INPUT)
        worker = self._start(folder, seed, result.engine)
        moved, before = time.monotonic(), -1
        while (code := worker.poll()) is None:
            time.sleep(_LOOK_S)
            (run, refused, result.kept), _ = board.read()
            result.refused = before_it + refused
            result.inputs = max(result.inputs, run)
            result.seconds = round(time.monotonic() - began, 1)
            self._progress(result)
            if run != before:
                moved, before = time.monotonic(), run
            if self._seconds and time.monotonic() - began > self._seconds:
                worker.kill()
                worker.wait()
                return None, b""
            if time.monotonic() - moved > STUCK_S:
                worker.kill()
        (run, refused, result.kept), data = board.read()
        result.refused = before_it + refused
        result.inputs = max(result.inputs, run)
        return code, data

    def _alone(self, data: bytes) -> bool:
        """Run one input in a worker of its own; return whether it finds something again."""
        with tempfile.TemporaryDirectory(prefix="rampart-fuzz-", dir=_memory()) as name:
            (Path(name) / "one").write_bytes(data)
            code = self._start(Path(name), 0, "one").wait()
            return code != 0 or any(Path(name).glob("found-*"))

    def _start(self, folder: Path, seed: int, engine: str) -> subprocess.Popen[bytes]:
        path = [str(ROOT), *filter(None, sys.path)]
        environment = {**os.environ, "PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1",
                       "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(path)}
        what = (self._target.name, folder, self.result.inputs, self._runs, seed, engine)
        return subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.worker", *map(str, what)], env=environment,
            cwd=folder, stdout=subprocess.DEVNULL,
            stderr=None if "FUZZ_SHOW" in os.environ else subprocess.DEVNULL)

    def _collect(self, folder: Path) -> None:
        for path in sorted(folder.glob("found-*.json")):
            self._found(json.loads(path.read_text())["what"],
                        path.with_suffix("").read_bytes())

    def _found(self, what: str, data: bytes) -> None:
        if any(found["what"] == what and what[0].isupper() for found in self.result.findings):
            return
        path = self._keep / self._target.name / hashlib.sha256(data).hexdigest()[:12]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        if not self._alone(data):
            what += ", but not when it is run alone: something gathers"
        shown = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
        self.result.findings.append({"what": what, "input": str(shown)})


def _memory() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def _name_of(code: int) -> str:
    if code == -signal.SIGPROF:
        return f"hang: more than {LIMIT_S:g} s of processor time"
    if code < 0:
        return f"death by {signal.Signals(-code).name}"
    return f"death with exit code {code}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make fuzz FUZZ=...", formatter_class=argparse.RawDescriptionHelpFormatter,
        description=__doc__, epilog="exit code: 0 nothing was found; 1 something was; 2 bad usage")
    parser.add_argument("--runs", type=int, default=RUNS, metavar="N",
                        help=f"inputs per target (default: {RUNS})")
    parser.add_argument("--target", action="append", default=[], metavar="NAME",
                        help="only this target (repeatable); see --list")
    parser.add_argument("--module", action="append", default=[], metavar="NAME",
                        help="import this one too, for the targets that it registers (repeatable)")
    parser.add_argument("--seconds", type=float, default=0.0, metavar="S",
                        help="end each target after so many real seconds")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="default: 1")
    parser.add_argument("--engine", choices=("guided", "own"), help="default: guided, where atheris"
                        " is installed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N",
                        help="targets at a time (default: one per processor)")
    parser.add_argument("--keep", type=Path, default=CORPUS, metavar="DIR",
                        help="where findings go (default: tests/fuzz/corpus)")
    parser.add_argument("--list", action="store_true", help="list the targets")
    parser.add_argument("--json", action="store_true", help="print the results as JSON at the end")
    return parser


class Screen:
    """Shows how far it is: lines that overwrite each other on a terminal, else a line a minute."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._terminal = sys.stderr.isatty()
        self._next = 0.0
        self._now: dict[str, Result] = {}

    def progress(self, result: Result) -> None:
        """Show a result so far."""
        with self._lock:
            self._now[result.target] = result
            if time.monotonic() < self._next:
                return
            self._next = time.monotonic() + (0.5 if self._terminal else 60.0)
            text = "; ".join(f"{r.target} {r.inputs}" for r in self._now.values())
            print(f"\r{text[:110]:110}" if self._terminal else text, file=sys.stderr,
                  end="" if self._terminal else "\n", flush=True)

    def over(self, result: Result) -> None:
        """Show a result."""
        with self._lock:
            self._now.pop(result.target, None)
            speed = result.inputs / max(result.seconds, 0.1)
            print(f"{chr(13) if self._terminal else ''}{result.target:16} {result.engine:6} "
                  f"{result.inputs:8} inputs {result.seconds:7.1f} s {speed:8.0f}/s "
                  f"{result.refused:8} refused, {len(result.findings)} found",
                  file=sys.stderr, flush=True)
            for found in result.findings:
                print(f"    {found['what']}: {found['input']}", file=sys.stderr, flush=True)


def main() -> int:
    """Fuzz what the command line asks for."""
    options = _parser().parse_args()
    os.environ[targets.MORE] = ",".join(options.module)
    for module in options.module:
        import_module(module)
    if options.list:
        print("\n".join(sorted(targets.ALL)))
        return 0
    wrong = [name for name in options.target if name not in targets.ALL]
    if wrong or options.runs < 1 or options.jobs < 1:
        print(f"no target {wrong[0]!r}; there are: {', '.join(sorted(targets.ALL))}" if wrong
              else "--runs and --jobs must be 1 or more", file=sys.stderr)
        return 2
    engine = options.engine or ("guided" if find_spec("atheris") else "own")
    if engine == "own" and not options.engine:
        print("atheris is not installed (pip install 'rampart-robot[fuzz]'): inputs are made by "
              "our own engine, without regard to coverage", file=sys.stderr)
    chosen = [targets.ALL[name] for name in options.target or sorted(targets.ALL)]
    screen = Screen()

    def fuzz(target: Target) -> Result:
        result = Fuzzing(target, engine, runs=options.runs, seconds=options.seconds,
                         seed=options.seed, keep=options.keep.resolve(),
                         progress=screen.progress).run()
        screen.over(result)
        return result

    with ThreadPoolExecutor(options.jobs) as pool:
        results = list(pool.map(fuzz, chosen))
    if options.json:
        print(json.dumps([asdict(result) for result in results], indent=2))
    return 1 if any(result.findings for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
