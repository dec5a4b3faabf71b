"""The keys that every system has, declared once."""

from __future__ import annotations

from typing import Any

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.ftm import messages as m

# Detection, recovery, manager.
HOLDS = Topic("holds/{name}", m.Holds, Qos.STATE, 5, "",
              "Holders of {name} that are no recovery modules of the system; silent while there "
              "are none. `rampart reset` lets go in their place.")
DETECTION = Topic("detection/{name}", m.DetectionReport, Qos.STATE, 5, "",
                  "State of detection module {name}.", resend_s=1)
RECOVERY_COMMAND = Topic("recovery/{name}/command", m.RecoveryCommand, Qos.STATE, 5, "",
                         "What the manager orders recovery module {name} to do.", resend_s=1)
RECOVERY = Topic("recovery/{name}/state", m.RecoveryReport, Qos.STATE, 5, "",
                 "State of recovery module {name}.", resend_s=1)
DECISION = Topic("manager/decision", m.DecisionRecord, Qos.COMMAND, 0, "",
                 "Each decision of the FTM Manager with its certificate.")
SHADOW = Topic("manager/shadow", m.ShadowRecord, Qos.COMMAND, 0, "",
               "What the strategy in shadow would have decided, where it differs.")
ADAPT = Topic("manager/adapt", m.AdaptationRequest, Qos.COMMAND, 0, "",
              "Change a module, a mechanism or the strategy while running.", outside=True)
ADAPTATION = Topic("manager/adaptation", m.AdaptationAnswer, Qos.COMMAND, 0, "",
                   "Whether a change was made, and why not.")
ADAPTED_SYSTEM = Topic("manager/system", m.AdaptedSystem, Qos.STATE, 1, "",
                       "The changed system, whole; silent while nothing was changed.")
MANAGER_STATUS = Topic("manager/status", m.ManagerStatus, Qos.STATE, 10, "",
                       "The FTM Manager's view; its silence stops the robot.", resend_s=1)
RESET = Topic("manager/reset", m.Reset, Qos.COMMAND, 0, "", "Release a latched recovery.",
              outside=True)

# Runtime and supervision.
NODES = Topic("supervisor/nodes", m.NodeTable, Qos.STATE, 2, "", "The supervisor's node table.")
HOST_NODES = Topic("supervisor/{name}/nodes", m.NodeTable, Qos.STATE, 2, "",
                   "What supervisor {name} runs, of a system of several hosts; for the others.")
CHECKPOINTS = Topic("supervisor/{name}/checkpoints", m.Checkpoints, Qos.SENSOR, 2, "",
                    "What the host of supervisor {name} holds of states that two hosts have; in a "
                    "system of several, with checkpoints.")
RESPAWN = Topic("supervisor/respawn", m.RespawnRequest, Qos.COMMAND, 0, "",
                "Ask for a node to be respawned.")
SIGNAL = Topic("supervisor/signal", m.SignalOrder, Qos.COMMAND, 0, "",
               "Signal the process of a node that runs on another host, as `kill-node` does on its "
               "own; in a system of several.", outside=True)
PROCESS_EVENT = Topic("supervisor/event", m.ProcessEvent, Qos.COMMAND, 0, "",
                      "What happened to processes.")
PROGRAM_END = Topic("supervisor/program_end", m.ProgramEnd, Qos.COMMAND, 0, "",
                    "The program of a command has ended; its node's process stays.")

# Stand-ins for modules that are not written yet.
STUB_TRIGGER = Topic("stub/trigger", m.StubTrigger, Qos.COMMAND, 0, "",
                     "Make the stand-in of a detection module active or idle.", outside=True)

ALL: tuple[Topic[Any], ...] = (
    *bus_topics.ALL, *(v for v in globals().values() if isinstance(v, Topic)))
"""Those of the bus as well."""
