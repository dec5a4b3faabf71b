"""Whether what passes between ROS 2 and a system makes sense, as far as its tables alone say."""

from __future__ import annotations

from collections.abc import Iterator

from rampart.manager.spec.ros2 import GATEWAY, WAYS
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import Finding, unknown


def find_wrong_links(spec: SystemSpec) -> Iterator[Finding]:
    """Find tables that say too little, too much, or the same twice."""
    gateways = [node.name for node in spec.nodes if node.actor == GATEWAY]
    if spec.ros2 and not gateways:
        yield Finding("$.ros2", f"no node passes it on; one of actor {GATEWAY} does")
    there: dict[tuple[str, str], int] = {}
    for number, link in enumerate(spec.ros2):
        path = f"$.ros2[{number}]"
        ways = [way for way in WAYS if getattr(link, way)]
        if len(ways) != 1:
            yield Finding(path, f"one of {', '.join(WAYS)} is right, and it has "
                                f"{' and '.join(ways) or 'none'}")
            continue
        way, = ways
        for field, key in (("to", link.to), ("from", link.from_)):
            if (field in WAYS[way]) != bool(key):
                wanted = " and ".join(f"{one} = 'key'" for one in WAYS[way])
                yield Finding(f"{path}.{field}", f"with {way}, {wanted} of a topic of the system "
                                                 "is right", (key,))
        kind = {"call": "srv", "serve": "srv", "goal": "action"}.get(way)
        is_fit = kind is None or link.type.split("/")[1] in {kind, "action"}
        if not is_fit:
            yield Finding(f"{path}.type", f"with {way}, package/{kind}/Name is right", (link.type,))
        for field, of in (("stop_after_s", "publish"), ("answer", "call, serve or goal")):
            if getattr(link, field) and way not in of:
                yield Finding(f"{path}.{field}", f"is for {of}", (getattr(link, field),))
        if link.beside and (way != "subscribe" or link.beside not in {
                one.to for one in spec.ros2 if one.subscribe}):
            yield Finding(f"{path}.beside", "the `to` of another subscription is right",
                          (link.beside,))
        if link.gateway and link.gateway not in gateways:
            yield unknown(f"{path}.gateway", link.gateway, "gateway", gateways)
        for what in ((way, link.name), ("to", link.to)):
            if what[1] and what in there:
                yield Finding(f"{path}.{what[0]}", f"is in ros2[{there[what]}] already", (what[1],))
            there.setdefault(what, number)
