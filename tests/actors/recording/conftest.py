"""A small recording, a port for a run, and what stands for its launcher."""

import subprocess
import sys

import pytest

from rampart.testing import free_base_port
from tests.actors.recording.samples import sample, write


@pytest.fixture
def recording(tmp_path):
    """The file of a closed recording of `sample()`."""
    write(tmp_path / "run.mcap", sample())
    return tmp_path / "run.mcap"


@pytest.fixture
def port():
    return free_base_port()


@pytest.fixture
def launcher():
    """A process that may be killed for a launcher; it has no run."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        yield process
        process.kill()
