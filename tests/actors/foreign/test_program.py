"""What a program gets from its node's process."""

from __future__ import annotations

import os

from rampart.actors.foreign.program import inherited_environment
from tests import ROOT


def test_a_path_of_python_is_inherited_unless_it_leads_to_this_rampart(monkeypatch):
    ros = "/opt/ros/jazzy/lib/python3.12/site-packages"
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), ros]))
    assert inherited_environment()["PYTHONPATH"] == ros
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    assert "PYTHONPATH" not in inherited_environment()
    monkeypatch.delenv("PYTHONPATH")
    assert inherited_environment() == dict(os.environ)
