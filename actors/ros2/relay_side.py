"""The network of ROS 2 by a relay: a program with `rclpy`, over any middleware.

Most robots are on DDS. `rclpy` follows whatever their environment sets: middleware, discovery,
security. It needs the Python of its installation, so it runs in a process of its own, `relay.py`,
and exchanges encoded messages with this one. If the relay ends or hangs, this process has failed:
the supervisor restarts both.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from pathlib import Path
from typing import IO, Any, cast

import msgspec

from rampart.actors.foreign.program import inherited_environment
from rampart.actors.foreign.pulse import Pulse
from rampart.actors.ros2.side import NO_ANSWER, Answered, Deliver, Reply
from rampart.actors.ros2.wire import (
    UNKNOWN_GID,
    UNKNOWN_HASH,
    Attachment,
    Endpoint,
    EndpointKind,
    Qos,
    dds_name,
    ros_name,
)

RELAY = Path(__file__).with_name("relay.py")
HANG_S = 1.0
"""A relay that does not answer for so long hangs."""

_LENGTHS = struct.Struct(">II")
_READ_BYTES = 1 << 20
_TAIL_BYTES = 2000
_END_S = 0.5
_SESSION = "rclpy"


class RelayError(RuntimeError):
    """The relay cannot be started, has ended, or hangs; one line."""


class RelaySide:
    """A node of `rclpy` in a process of its own; further methods are those of `Side`.

    Args:
        name: of the node in ROS 2.
        namespace: of the node.
        domain: of ROS.
        distribution: name of the distribution.
        setup: file that bash sources first, e.g. a workspace's `install/setup.bash`; "" for the
            environment as it is, else an active virtual environment with rclpy, else
            `/opt/ros/DISTRIBUTION/setup.bash`.
        lost: called once with a `RelayError` when the relay has ended.
        output: takes what the relay prints, if given.
        whole: whether the graph has the endpoints of all topics, or those of our topics only.
        first_s: how long the relay may take to start.

    Attributes:
        id: of this side in tokens.
        problems: why endpoints exchange nothing, one line each.

    Raises:
        RelayError: there is no ROS 2.
    """

    def __init__(self, name: str, namespace: str, domain: int, distribution: str, setup: str, *,
                 lost: Callable[[RelayError], None],
                 output: Callable[[bytes], None] | None = None, whole: bool = False,
                 first_s: float = 10.0) -> None:
        self.id = f"{_SESSION}-{os.getpid()}"
        self.problems: list[str] = []
        self._domain, self._distribution = domain, distribution
        self._lost, self._output = lost, output
        self._loop = asyncio.get_running_loop()
        self._pulse = Pulse(HANG_S, max(first_s, HANG_S), HANG_S)
        self._numbers = count(1)
        self._readers: dict[str, Deliver] = {}
        self._asked: dict[int, tuple[bytes, Answered, asyncio.TimerHandle]] = {}
        self._watchers: list[Callable[[str, bool], None]] = []
        self._own_tokens: list[str] = []
        self._tokens: dict[str, None] | None = None  # of other nodes, in order
        self._in, self._out, self._tail = bytearray(), bytearray(), b""
        self._is_over = False
        self._start(setup_file(setup, distribution), name, namespace, whole=whole)

    def _start(self, setup: str, name: str, namespace: str, *, whole: bool) -> None:
        self._socket, theirs = socket.socketpair()
        command = (["bash", "-c", '. "$0" && exec python3 "$@"', setup] if setup else ["python3"])
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 the user's own ROS 2
                [shutil.which("setpriv") or "setpriv", "--pdeathsig", "KILL", *command, str(RELAY),
                 str(theirs.fileno()), name, namespace, str(int(whole))],
                env=_environment(self._domain), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, pass_fds=[theirs.fileno()], start_new_session=True)
        self._printed = cast("IO[bytes]", self._process.stdout)
        for file in (self._socket, self._printed):
            os.set_blocking(file.fileno(), False)
        self._loop.add_reader(self._socket, self._readable)
        self._loop.add_reader(self._printed, self._print)

    # -- as a Side -------------------------------------------------------------------------------

    def token(self, key: str) -> None:
        """See `Side.token`; rclpy declares the endpoints itself, a client is declared here."""
        self._own_tokens.append(key)
        mine = Endpoint.parse(key)
        if mine.kind is EndpointKind.CLIENT:
            self._declare(mine.kind, mine.key, mine.qos)
        for changed in self._watchers:
            changed(key, True)

    def tokens(self, pattern: str, changed: Callable[[str, bool], None]) -> None:
        """See `Side.tokens`; the pattern is always that of the domain."""
        del pattern
        self._watchers.append(changed)
        for token in (*self._own_tokens, *(self._tokens or ())):
            changed(token, True)

    def publisher(self, key: str, qos: Qos) -> Callable[[bytes, bytes], None]:
        """See `Side.publisher`."""
        topic = self._declare(EndpointKind.PUBLISHER, key, qos)
        return lambda payload, _attachment: self._send(
            "put", topic, time.monotonic(), payload=payload)

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        """See `Side.subscribe`."""
        self._readers[self._declare(EndpointKind.SUBSCRIPTION, key, qos)] = deliver

    def serve(self, key: str, asked: Callable[[bytes, bytes | None, Reply], None]) -> None:
        """See `Side.serve`; only stand-ins offer services, and they use no relay."""
        raise NotImplementedError

    def ask(self, key: str, payload: bytes, attachment: bytes, timeout_s: float,
            answered: Answered) -> None:
        """See `Side.ask`."""
        number = next(self._numbers)

        def over() -> None:
            self._send("forget", number)
            self._on_answer(number, False, b"")

        self._asked[number] = attachment, answered, self._loop.call_later(timeout_s, over)
        self._send("ask", number, _parts(key)[0], payload=payload)

    def is_linked(self) -> bool:
        """See `Side.is_linked`: whether the relay has looked at the graph."""
        return self._tokens is not None

    def is_well(self, now_s: float) -> bool:
        """Whether the relay answers; if it hangs, it is killed."""
        self._send("ping", next(self._numbers))
        if self._pulse.is_well(now_s):
            return True
        self._fail(f"hung: no answer for {self._pulse.limit_s:g} s")
        return False

    def look_for(self, types: Iterable[str]) -> None:
        """Look for types in the environment of the relay; a missing one is one of `problems`."""
        for ros_type in types:
            self._send("declare", "", "", ros_type, "", None)

    def close(self) -> None:
        """See `Side.close`: publish what waits, and leave the graph."""
        if self._is_over:
            return
        self._stop_reading()
        try:
            self._socket.settimeout(_END_S)
            self._socket.sendall(self._out)
            self._socket.shutdown(socket.SHUT_WR)
            self._process.wait(_END_S)
        except (OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        self._close_files()

    # -- frames ----------------------------------------------------------------------------------

    def _declare(self, kind: EndpointKind, key: str, qos: Qos) -> str:
        """Declare an endpoint and return its topic."""
        topic, ros_type, digest = _parts(key)
        self._send("declare", kind.value, topic, ros_type, digest, msgspec.structs.asdict(qos))
        return topic

    def _send(self, *header: Any, payload: bytes = b"") -> None:
        if self._is_over:
            return
        head = json.dumps(header).encode()
        self._out += _LENGTHS.pack(len(head), len(payload)) + head + payload
        self._write()

    def _write(self) -> None:
        try:
            del self._out[:self._socket.send(self._out)]
        except BlockingIOError:
            pass
        except OSError:  # it has ended; `_readable` sees that too
            self._out.clear()
        if self._out:
            self._loop.add_writer(self._socket, self._write)
        else:
            self._loop.remove_writer(self._socket)

    def _readable(self) -> None:
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._fail("ended")
            return
        self._in += data
        while len(self._in) >= _LENGTHS.size:
            head, payload = _LENGTHS.unpack_from(self._in)
            end = _LENGTHS.size + head + payload
            if len(self._in) < end:
                return
            frame = bytes(self._in[_LENGTHS.size:end])
            del self._in[:end]
            word, *header = json.loads(frame[:head])
            getattr(self, f"_on_{word}")(*header, frame[head:])

    def _print(self) -> None:
        try:
            data = os.read(self._printed.fileno(), _READ_BYTES)
        except BlockingIOError:
            return
        if not data:
            self._loop.remove_reader(self._printed)
            return
        self._tail = (self._tail + data)[-_TAIL_BYTES:]
        if self._output is not None:
            self._output(data)

    def _fail(self, why: str) -> None:
        """Report the end of the relay, and end it if it has not ended."""
        if self._is_over:
            return
        self._stop_reading()
        try:
            code = self._process.wait(_END_S if why == "ended" else 0)
            why += f": {'exit code' if code >= 0 else 'signal'} {abs(code)}"
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._print()
        self._close_files()
        lines = self._tail.decode(errors="replace").strip().splitlines()
        self._lost(RelayError(f"the relay to ROS 2 {why}{f'; {lines[-1]}' if lines else ''}"))

    def _stop_reading(self) -> None:
        self._is_over = True
        self._loop.remove_reader(self._socket)
        self._loop.remove_writer(self._socket)

    def _close_files(self) -> None:
        self._loop.remove_reader(self._printed)
        self._socket.close()
        self._printed.close()

    # -- from the relay --------------------------------------------------------------------------

    def _on_ready(self, distribution: str, _payload: bytes) -> None:
        if distribution not in {"", self._distribution}:
            self.problems.append(f"this ROS 2 is {distribution}, the gateway has "
                                 f"distribution = '{self._distribution}'")

    def _on_pong(self, _payload: bytes) -> None:
        self._pulse.beat()

    def _on_problem(self, why: str, _payload: bytes) -> None:
        self.problems.append(why)

    def _on_message(self, topic: str, gid: str, sequence: int, stamp_ns: int, payload: bytes
                    ) -> None:
        self._readers[topic](payload, Attachment(
            sequence, stamp_ns, bytes.fromhex(gid) if gid else UNKNOWN_GID).pack())

    def _on_answer(self, number: int, is_given: bool, payload: bytes) -> None:
        if found := self._asked.pop(number, None):
            attachment, answered, timer = found
            timer.cancel()
            if is_given:
                answered(payload, attachment, "")
            else:
                answered(None, None, NO_ANSWER)

    def _on_graph(self, nodes: list[list[str]], endpoints: list[list[Any]], _payload: bytes
                  ) -> None:
        before, copies = self._tokens or {}, Counter[str]()
        found = []
        for name, namespace in nodes:
            copies[f"{namespace} {name}"] += 1
            number = str(copies[f"{namespace} {name}"])
            found.append(Endpoint(self._domain, _SESSION, number, number, EndpointKind.NODE, name,
                                  namespace))
        found += [_endpoint(self._domain, row) for row in endpoints]
        self._tokens = dict.fromkeys(one.token for one in found)
        gone = [token for token in before if token not in self._tokens]
        new = [token for token in self._tokens if token not in before]
        for changed in self._watchers:
            for token in gone:
                changed(token, False)
            for token in new:
                changed(token, True)


def setup_file(setup: str, distribution: str) -> str:
    """Return the file that bash has to source, "" if the environment is sourced already.

    Raises:
        RelayError: there is no such file, or no ROS 2.
    """
    if setup:
        if not Path(setup).is_file():
            raise RelayError(f"setup = {setup!r}: no such file")
        return setup
    if "AMENT_PREFIX_PATH" in os.environ:
        return ""
    active = Path(os.environ.get("VIRTUAL_ENV", "/dev/null"))
    if any(active.glob("lib/python*/site-packages/rclpy")):
        return str(active / "bin/activate")
    usual = f"/opt/ros/{distribution}/setup.bash"
    if not Path(usual).is_file():
        raise RelayError("no ROS 2: no environment is sourced, no virtual environment with rclpy "
                         f"is active, and there is no {usual}; source one, or set "
                         "setup = '…/setup.bash' of the gateway")
    return usual


def _environment(domain: int) -> dict[str, str]:
    """Return the environment of the relay: without our own virtual environment.

    A killed node can leave a lock in the shared memory of Fast DDS, at which all nodes of the
    machine that start later hang (eProsima/Fast-DDS#5469), so the relay keeps off it.
    """
    found = ({"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"} | inherited_environment()
             | {"ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"})
    if sys.prefix != sys.base_prefix:
        found.pop("VIRTUAL_ENV", None)
        found["PATH"] = os.pathsep.join(one for one in found.get("PATH", "").split(os.pathsep)
                                        if Path(one) != Path(sys.prefix, "bin"))
    return found


def _parts(key: str) -> tuple[str, str, str]:
    """Return topic, type and hash of a key."""
    _, *topic, dds_type, digest = key.split("/")
    return f"/{'/'.join(topic)}", ros_name(dds_type), digest


def _endpoint(domain: int, row: Sequence[Any]) -> Endpoint:
    """Return an endpoint of the relay's graph; a type that is not of ROS 2 keeps its name."""
    kind, name, namespace, topic, ros_type, digest, reliable, transient_local, gid = row
    is_of_ros = ros_type.count("/") == 2
    return Endpoint(
        domain, _SESSION, "0", gid, EndpointKind(kind), name, namespace,
        topic=topic, type=dds_name(ros_type) if is_of_ros else ros_type.replace("/", "%"),
        hash=digest or UNKNOWN_HASH, qos=Qos(reliable, transient_local))
