"""The node that every peer keeps alive: Zenoh and numpy, one input, one output.

A program of its own that imports nothing of Rampart: `python -P peer_node.py NAME ENDPOINT`.
"""

import time

BEGUN_S = time.monotonic()

import json  # noqa: E402 the clock is read before anything is imported
import os  # noqa: E402
import signal  # noqa: E402
import sys  # noqa: E402

import numpy as np  # noqa: E402
import zenoh  # noqa: E402


def main(name: str, endpoint: str) -> None:
    """Hear scans, and publish the mean of each with who has computed it."""
    config = zenoh.Config()
    for key, value in (("mode", "client"), ("connect/endpoints", [endpoint]),
                       ("scouting/multicast/enabled", False), ("scouting/delay", 0)):
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    output = session.declare_publisher(f"bench/output/{name}", express=True)

    def work(sample: zenoh.Sample) -> None:
        scan = np.frombuffer(sample.payload.to_bytes())
        output.put(json.dumps([os.getpid(), BEGUN_S, scan[0], scan.mean()]))

    session.declare_subscriber("bench/input", work)
    signal.pause()


if __name__ == "__main__":
    main(*sys.argv[1:3])
