"""Topics that every actor publishes or subscribes to."""

from __future__ import annotations

from typing import Any

from rampart.actors.bus.messages import Diagnostic, Heartbeat, Injection, InjectionReport
from rampart.actors.bus.topic import Qos, Topic

HEARTBEAT = Topic("heartbeat/{name}", Heartbeat, Qos.STATE, 7, "",
                  "Proof that the event loop of node {name} turns.", resend_s=5, compared=False)
DIAGNOSTIC = Topic("diagnostic/{name}", Diagnostic, Qos.COMMAND, 0, "",
                   "Error report of node {name}.")
INJECT = Topic("inject/order", Injection, Qos.COMMAND, 0, "",
               "A fault to inject on a topic; tools send it too.")
INJECTION_REPORT = Topic("inject/report", InjectionReport, Qos.COMMAND, 0, "",
                         "How an injection took hold.")

ALL: tuple[Topic[Any], ...] = tuple(v for v in globals().values() if isinstance(v, Topic))
