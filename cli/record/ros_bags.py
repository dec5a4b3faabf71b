"""A recording as a bag of ROS 2. Needs the extra `ros2`."""

from __future__ import annotations

from pathlib import Path

import msgspec

from rampart.actors.recording.bag_reader import BagReader, Summary
from rampart.actors.recording.ros_bag import RosBag
from rampart.actors.recording.run_documents import recorded_system
from rampart.actors.ros2.gateway import Gateway
from rampart.actors.ros2.translation.tables import GATEWAY
from rampart.actors.ros2.translation.types import Types
from rampart.actors.system.topics import system_topics
from rampart.cli import systems
from rampart.cli.output import UsageError
from rampart.manager.spec.schema import SystemSpec


def write(file: Path, folder: Path, system: str | None, distribution: str | None
          ) -> tuple[RosBag, BagReader]:
    """Write a recording as a bag of ROS 2.

    Args:
        file: file of the recording.
        folder: folder of the bag; must not exist.
        system: system with actors and definitions; None for that of the recording.
        distribution: distribution of ROS 2; None for that of the system's gateway.

    Returns:
        The bag, with counts, and the reader of the recording.

    Raises:
        UsageError: a file cannot be read or written, or an option is wrong.
    """
    reader = BagReader(file)
    summary = Summary(reader)
    if not reader.is_recording:
        raise UsageError(f"{file}: an MCAP file of {reader.library or 'others'}; expected a "
                         "recording of a run")
    if system is None:
        _, known = recorded_system(summary.files)
        spec, topics = known.system, known.topics
    else:
        spec = systems.load(system)
        topics = system_topics(spec)
    bag = RosBag(_types(spec, distribution), topics)
    bag.write(reader, folder)
    return bag, reader


def _types(spec: SystemSpec, distribution: str | None) -> Types:
    """Return the types of a system's gateway, without those of folders that do not exist here."""
    gateway = Gateway.Parameters()
    for node in spec.nodes:
        if node.actor == GATEWAY:
            gateway = msgspec.convert(node.parameters, Gateway.Parameters, strict=False)
    folders = [path for path in map(Path, gateway.interfaces) if path.is_dir()]
    try:
        return Types(distribution or gateway.distribution, folders)
    except ValueError as error:
        raise UsageError(f"--{error}" if distribution else str(error)) from None
