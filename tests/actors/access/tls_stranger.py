"""A stranger who reaches the port of a router: another user, or on another network, or both.

Told on stdin, as JSON, where to go, what to show there, and every key; says what it achieved.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

import zenoh

from rampart.actors.bus.zenoh_session import session_config

NOBODY = 65534
_TALK_S = 1.0
_TOKEN = "rampart/alive/DM4/77"


def config_of(endpoint: str, shown: dict[str, str]) -> zenoh.Config:
    """Return the configuration of a client that shows what it has: a certificate, or none."""
    config = session_config((), [endpoint])
    for key, value in shown.items():
        config.insert_json5(f"transport/link/tls/{key}", json.dumps(value))
    return config


def talk(config: zenoh.Config, keys: list[str]) -> dict[str, Any]:
    """Join, publish, subscribe to and query everything; return how much succeeded."""
    heard: list[Any] = []
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        return {"joined": False, "heard": 0}
    with session:
        held = [session.declare_subscriber(key, heard.append) for key in
                ("**", *(f"rampart/{key}" for key in keys))]
        tokens = session.liveliness().declare_subscriber("**", heard.append, history=True)
        token = session.liveliness().declare_token(_TOKEN)
        answered = []
        end = time.monotonic() + _TALK_S
        while time.monotonic() < end:
            for key in keys:
                session.put(f"rampart/{key}", "stranger")
            answered += [r for r in session.get("rampart/**", timeout=0.2) if r.ok is not None]
        del held, token, tokens
    return {"joined": True, "heard": len(answered) + sum(
        sample.payload.to_bytes() != b"stranger" and str(sample.key_expr) != _TOKEN
        for sample in heard)}


def main() -> None:
    order = json.load(sys.stdin)
    if order["becomes_nobody"]:
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
    print(json.dumps({"user": os.getuid(), "tried": {
        f"{endpoint} {name}": talk(config_of(endpoint, shown), order["keys"])
        for endpoint in order["endpoints"] for name, shown in order["shown"].items()}}))


if __name__ == "__main__":
    main()
