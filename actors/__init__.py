"""Everything that runs as an actor: a mailbox, a state, one message at a time.

The classes of the engine that a system has without naming them are listed here, above all rooms:
`rampart.actors.system` loads them by name.
"""

if __name__ != "rampart.actors":
    raise ImportError("import it as rampart.actors: everything of Rampart has this one name")

ROLES = {
    "supervisor": "rampart.actors.supervision.supervisor:Supervisor",
    "first supervisor": "rampart.actors.hosts.host_supervisor:FirstSupervisor",
    "host supervisor": "rampart.actors.hosts.host_supervisor:HostSupervisor",
    "host observer": "rampart.actors.hosts.host_supervisor:HostObserver",
    "router": "rampart.actors.supervision.router:Router",
    "observer": "rampart.sim.runs.observer:Observer",
    "views": "rampart.actors.recording.views:Views",
    "lines": "rampart.cli.robot_lines:RobotLines",
}
"""Class of each."""

TAKES = {
    "panel": "rampart.actors.operator.hmi:Hmi",
    "ros2": "rampart.actors.ros2.gateway:Gateway",
}
"""Tables of a specification that are an actor's, and a class that takes each."""
