"""The node that each keeper of `benchmarks.peers` restarts: Zenoh and numpy, an input, an output.

It imports nothing of Rampart: `python -P peer_node.py NAME ENDPOINT`.
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
    """Publish the mean of each scan, and which process has computed it."""
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
    if sys.argv[1:] in ([], ["--help"]):
        print("usage: peer_node.py NAME ENDPOINT\n\n" + __doc__)
    else:
        main(*sys.argv[1:3])
