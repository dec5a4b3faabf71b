"""Fixtures that several test files share; helpers are modules of their own."""

from __future__ import annotations

import os
import sys
import tempfile

import hypothesis
import pytest

from rampart.actors.bus import run_folder
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoint
from rampart.cli.main import main
from tests import ROOT
from tests.actors.operator.browser import CHROMIUM

# A thousand interpreters are started: each keeps what it compiles, whatever the environment says.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# What waits for a processor at the lowest priority is not slow. `make test-nightly` tries more.
hypothesis.settings.register_profile("patient", deadline=None, max_examples=25,
                                       derandomize=True)
hypothesis.settings.register_profile("thorough", deadline=None, max_examples=200)
hypothesis.settings.register_profile(
    "fuzz", deadline=None, max_examples=int(os.environ.get("FUZZ_RUNS", "10000")))
hypothesis.settings.load_profile("patient")

WANTING = {
    "page": (CHROMIUM is not None, "RAMPART_TEST_PAGE",
             "no Chromium: `apt-get install chromium` brings it"),
    "ros": ((ROOT / ".venv-ros/bin/python").exists(), "RAMPART_TEST_ROS",
            "no wheels of ROS 2: `make ros-wheels` brings them")}
"""By marker: whether that is there which its tests need, where it must not be missing, and how it
is to be had."""


VIRTUAL = ("tests/whole/test_virtual_run.py", "tests/whole/test_checkpointed_nodes.py",
           "tests/whole/test_verdict_anyway.py",
           "tests/sim/campaign", "tests/manager/analysis", "tests/cli/analyse",
           "tests/actors/osmosis", "tests/actors/ros2/test_against_ros.py",
           "examples/nav2")
"""Tests that only compute, long and in virtual time: they run beside those on real processes."""

TIMED = "tests/actors/osmosis/control/teleoperation"
"""These among them go by the clock."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the tests that only compute."""
    for item in items:
        if item.nodeid.startswith(VIRTUAL) and not item.nodeid.startswith(TIMED):
            item.add_marker("virtual")


def pytest_runtest_setup(item):
    """Skip a test for which something is missing; where a variable says so, fail it."""
    for marker, (is_there, variable, how) in WANTING.items():
        if not is_there and item.get_closest_marker(marker):
            (pytest.fail if os.environ.get(variable) else pytest.skip)(how)


@pytest.fixture(autouse=True, scope="session")
def state_home(tmp_path_factory):
    """Runs of the tests keep their incidents there, not with those of the user."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(autouse=True)
def own_path():
    """What a test has admitted to the path of imports, as its working folder, ends with it."""
    before, loaded = list(sys.path), set(sys.modules)
    yield
    sys.path[:] = before
    for name in sys.modules.keys() - loaded:
        spec = getattr(sys.modules[name], "__spec__", None)
        places = [spec.origin, *(spec.submodule_search_locations or ())] if spec else []
        if any(place and place.startswith(tempfile.gettempdir()) for place in places):
            del sys.modules[name]


@pytest.fixture
def refused(capsys):
    """Return a function that has `rampart` refuse arguments in one line, and returns that line."""
    def refused(*arguments: object, code: int = 2) -> str:
        assert main([str(argument) for argument in arguments]) == code
        told = capsys.readouterr()
        assert (told.out, told.err.count("\n")) == ("", 1), told
        return told.err

    return refused


@pytest.fixture
def sockets():
    """The folder of a run, for sockets: the tests' own would make their addresses too long."""
    folder = run_folder.make(0, os.getpid())
    yield folder
    run_folder.remove(folder)


@pytest.fixture
async def bus_folder(sockets):
    """The folder of a run that has a router, by which sessions of `ZenohBus` hear each other."""
    router = ZenohBus("router_a", [], [endpoint(sockets, "router_a")])
    await router.open()
    yield sockets
    await router.close()
