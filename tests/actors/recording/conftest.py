"""A small recording, and a port for a run."""

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
