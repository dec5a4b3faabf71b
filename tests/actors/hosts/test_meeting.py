"""Rendezvous of the launchers: readiness, equal files, the end of the run."""

import asyncio
import contextlib
import re
import socket
import ssl
import threading
from contextlib import asynccontextmanager

import msgspec
import pytest
from websockets.asyncio.client import connect
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed, InvalidStatus

from rampart.actors.access import key_folder
from rampart.actors.bus.zenoh_session import Credentials, credentials_in
from rampart.actors.hosts.launchers import OtherLauncher
from rampart.actors.hosts.meeting import (
    DOOR,
    Attendance,
    Meeting,
    MeetingError,
    RunOverError,
    contents_of,
    joined,
    tls_context,
)
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.supervision.launcher import Launcher
from rampart.actors.system.hosts import Hosts
from rampart.actors.system.members import load_application
from rampart.actors.web.access import PagePlan
from rampart.systems import DEFAULT
from rampart.testing import eventually
from rampart.testing.ports import free_port
from tests.two_hosts import two_hosts

PLAN = RunPlan("r1", 7450, seed=7, system_file="/there/x.toml", folder="/f",
               page=PagePlan(token="t0ken-of-mine", secret="k3y"))
CONTENTS = {"rampart": "aa", "specification": "bb", "airport": "cc"}
FIRST = {"rampart": "aa", "specification": "bb"}


@asynccontextmanager
async def meeting(*hosts: str, credentials: Credentials | None = None):
    where = ("127.0.0.1", free_port())
    made = Meeting(PLAN, hosts or ("ground",), CONTENTS, lambda: {"hmi": 3})
    await made.open(*where, credentials)
    try:
        yield made, where
    finally:
        await made.close()


async def test_the_first_waits_until_the_others_are_ready_and_all_begin():
    async with meeting() as (made, where):
        said: list[str] = []
        waiting = asyncio.create_task(made.all_ready(said.append, lambda: False))
        ground = Attendance("ground", where, FIRST)
        told, asked_s, heard_s = await ground.ask()
        assert not re.search(b"t0ken|k3y", msgspec.json.encode(told.plan))  # no secret travels
        own = RunPlan(base_port=7451, system_file="/here/x.toml", host="ground")
        assert joined(told.plan, own) == msgspec.structs.replace(own, run_id="r1", seed=7)
        assert (told.plan.seed, told.origin_s, told.waits_for) == (7, None, ("ground",))
        assert told.incarnations == {"hmi": 3}
        assert asked_s <= told.now_s <= heard_s
        assert not waiting.done()
        ground.ready(CONTENTS)
        await ground.ask()
        await waiting
        made.begin(12.5)
        assert (await ground.ask())[0].origin_s == 12.5
        assert said == ["waiting for ground: rampart run --host ground there"]
        await ground.close()


@pytest.mark.parametrize(("host", "contents", "words"), [
    ("moon", FIRST, "no host 'moon'; this run waits for ground"),
    ("ground", FIRST | {"specification": "xx"}, "specification: not the same .*copy it from there"),
    ("ground", FIRST | {"rampart": "older"}, "rampart: not the same as on the first host")])
async def test_a_host_that_may_not_take_part_gets_the_reason(host, contents, words):
    async with meeting() as (_, where):
        with pytest.raises(MeetingError, match=words):
            await Attendance(host, where, contents).ask()


async def test_a_host_that_takes_part_is_not_replaced_and_has_the_files_of_the_plan():
    async with meeting("ground", "moon") as (_, where):
        ground = Attendance("ground", where, FIRST)
        await ground.ask()
        ground.ready(FIRST)
        with pytest.raises(MeetingError, match="airport: not the same"):
            await ground.ask()
        ground = Attendance("ground", where, FIRST)
        ground.ready(CONTENTS)
        await ground.ask()
        with pytest.raises(MeetingError, match="host ground takes part already"):
            await Attendance("ground", where, FIRST).ask()
        await ground.close()


async def test_a_second_start_of_a_host_is_counted_and_the_first_one_is_refused():
    async with meeting() as (made, where):
        old = Attendance("ground", where, FIRST)
        old.ready(CONTENTS)
        await old.ask()
        made.begin(1.0)
        new = Attendance("ground", where, FIRST)
        told, _, _ = await new.ask()
        assert (told.starts, told.origin_s) == (2, 1.0)
        with pytest.raises(MeetingError, match="host ground was started again"):
            await old.ask()
        await new.close()


async def test_one_that_goes_before_the_start_is_waited_for_again():
    async with meeting("ground", "moon") as (made, where):
        said: list[str] = []
        waiting = asyncio.create_task(made.all_ready(said.append, lambda: False))
        ground = Attendance("ground", where, FIRST)
        ground.ready(CONTENTS)
        await ground.ask()
        await eventually(lambda: len(said) == 2)
        await ground.close()
        await eventually(lambda: len(said) == 3)
        assert [line.partition(":")[0] for line in said] == [
            "waiting for ground, moon", "waiting for moon", "waiting for ground, moon"]
        waiting.cancel()
        assert not await made.all_ready(said.append, lambda: True), "the user has interrupted it"


@pytest.mark.parametrize("later_s", [0.05, 1.0])  # over a bad line it is sent again
async def test_the_others_are_notified_of_the_end(later_s):
    async with meeting() as (made, where):
        ground = Attendance("ground", where, FIRST)
        await ground.ask()
        closing = asyncio.create_task(made.close())
        await asyncio.sleep(later_s)
        with pytest.raises(RunOverError, match="the first host has ended it"):
            await ground.ask()
        await closing


async def test_no_answer_and_a_nonsense_answer_are_errors_that_may_pass():
    with pytest.raises(OSError, match="Connect call failed"):
        await Attendance("ground", ("127.0.0.1", free_port()), FIRST).ask()

    async def answer(connection):
        async for _ in connection:
            await connection.send("nonsense")

    async with serve(answer, "127.0.0.1", 0) as server:
        with pytest.raises(OSError, match="no answer"):
            await Attendance("ground", server.sockets[0].getsockname(), FIRST).ask()


@pytest.mark.parametrize("sent", [
    b"", b"GET / HTTP/1.1\r\n\r\n", b"x" * 2_000_000, "garbage", '{"host":"ground"}',
    '{"host":"ground","serial":"1","contents":5}', "x" * 2_000_000])
async def test_a_stranger_is_disconnected_and_disturbs_no_host(sent):
    """It sends bytes, or a question that makes no sense."""
    async with meeting() as (_, where):
        if isinstance(sent, bytes):
            reader, writer = await asyncio.open_connection(*where)
            with contextlib.suppress(ConnectionError):  # there was more than is read
                writer.write(sent)
                writer.write_eof()
                assert b"r1" not in await asyncio.wait_for(reader.read(), 10)
            writer.close()
        else:
            async with connect("ws://first/", host=where[0], port=where[1]) as stranger:
                await stranger.send(sent.encode())
                with pytest.raises(ConnectionClosed):
                    await asyncio.wait_for(stranger.recv(), 10)
        with pytest.raises(InvalidStatus, match="403"):  # a page in a browser
            await connect("ws://first/", host=where[0], port=where[1], origin="http://evil.example")
        ground = Attendance("ground", where, FIRST)
        assert (await ground.ask())[0].plan.run_id == "r1"
        await ground.close()


async def test_an_address_that_is_not_this_machine_s_is_told_in_a_line():
    made = Meeting(PLAN, ("ground",), CONTENTS, dict)
    with pytest.raises(MeetingError, match=r"cannot listen at 192\.0\.2\.1 port 7462"):
        await made.open("192.0.2.1", 7462)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        with pytest.raises(MeetingError, match="for the other hosts"):
            await made.open(*taken.getsockname())


def test_contents_do_not_depend_on_where_the_files_are(tmp_path):
    text = DEFAULT.read_text(encoding="utf-8")
    here, changed = tmp_path / "a.toml", tmp_path / "b.toml"
    here.write_text(f"# a remark\n{text}", encoding="utf-8")
    changed.write_text(text.replace("intensity = 50", "intensity = 51"), encoding="utf-8")
    hashes = [contents_of(RunPlan(system_file=str(file))) for file in (DEFAULT, here, changed)]
    assert hashes[0] == hashes[1]
    assert {name for name in hashes[0] if hashes[0][name] != hashes[2][name]} == {"specification"}


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meeting") / "keys"
    key_folder.init(folder)
    key_folder.issue(folder, ["router_a", "router_b"], "router")
    key_folder.issue(folder, ["observer", "observer_ground", "observer_moon", "DM5"], "node")
    revoked = (folder / "observer_moon.pem").read_bytes()
    key_folder.revoke(folder, ["observer_moon"])
    (folder / "observer_moon.pem").write_bytes(revoked)
    (folder / "observer_moon.pem").chmod(0o600)
    return folder


@pytest.mark.parametrize(("door", "name", "error"), [
    (DOOR, "observer_ground", None), (DOOR, "DM5", OSError), (DOOR, "observer", OSError),
    (DOOR, "observer_moon", OSError), (DOOR, "", OSError),
    ("router_b", "observer_ground", MeetingError)])
async def test_with_keys_only_the_other_launcher_gets_an_answer_and_only_from_router_a(
        keys, door, name, error):
    """The key of observer_moon is revoked."""
    async with meeting(credentials=credentials_in(str(keys), door)) as (_, where):
        ground = Attendance("ground", where, FIRST, credentials_in(str(keys), name)
                            if name else None)
        with pytest.raises(error) if error else contextlib.nullcontext():
            assert (await ground.ask())[0].plan.run_id == "r1"
        await ground.close()


UPGRADE = (b"GET / HTTP/1.1\r\nHost: first\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
           b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n")


@pytest.mark.parametrize("silent", ["ground", "first"])
async def test_with_keys_nobody_waits_for_a_silent_peer(keys, silent):
    """A line that was cut, a launcher that is stopped: TLS would wait half a minute for a word."""
    where = ("127.0.0.1", free_port())
    is_there, is_over = threading.Event(), threading.Event()

    def ground():
        secure = tls_context(credentials_in(str(keys), "observer_ground"), ssl.Purpose.SERVER_AUTH)
        with secure.wrap_socket(socket.create_connection(where)) as peer:
            peer.sendall(UPGRADE)
            assert peer.recv(100_000).startswith(b"HTTP/1.1 101 ")
            is_there.set()
            is_over.wait()

    def first():
        secure = tls_context(credentials_in(str(keys), DOOR), ssl.Purpose.CLIENT_AUTH)
        with socket.create_server(where) as server:
            is_there.set()
            with secure.wrap_socket(server.accept()[0], server_side=True) as peer:
                peer.recv(100_000)
                is_over.wait()

    made = Meeting(PLAN, ("ground",), CONTENTS, dict)
    if silent == "ground":
        await made.open(*where, credentials_in(str(keys), DOOR))
    thread = threading.Thread(target=ground if silent == "ground" else first)
    thread.start()
    try:
        await asyncio.to_thread(is_there.wait)
        async with asyncio.timeout(15):
            if silent == "ground":
                await made.close()
            else:
                other = Attendance("ground", where, FIRST,
                                   credentials_in(str(keys), "observer_ground"))
                with pytest.raises(TimeoutError):
                    await other.ask()
    finally:
        is_over.set()
        thread.join()


async def test_a_host_does_not_stay_in_another_run_of_the_first_one(tmp_path, monkeypatch):
    """Its launcher was killed and started again, perhaps at another rate; no end was published."""
    async def nothing(_launcher):
        pass

    monkeypatch.setattr(Launcher, "load", nothing)
    monkeypatch.setattr(Launcher, "start", nothing)
    file = tmp_path / "two.toml"
    file.write_text(two_hosts({"robot": "127.0.7.1", "ground": "127.0.7.2"},
                              ("camera", "part_finder", "D_VISION_CRASH"), "cell", 0.1))
    own, said = RunPlan(system_file=str(file), host="ground"), []
    port = Hosts(load_system(own)).meeting_place()[1]
    plan = RunPlan("r1", system_file=str(file))
    contents = contents_of(plan, load_application(plan, load_system(plan)))
    first = Meeting(plan, ("ground",), contents, dict)
    await first.open("127.0.7.1", port)
    link, root = socket.socketpair()
    ground = OtherLauncher(own, said.append, link)
    await ground.join()
    starting = asyncio.create_task(ground.start())
    await first.all_ready(said.append, lambda: False)
    first.begin(100.0)
    await starting
    await ground.end()
    await first.close()  # the other one cannot be reached
    again = Meeting(msgspec.structs.replace(plan, run_id="r2"), ("ground",), contents, dict)
    await again.open("127.0.7.1", port)
    with pytest.raises(MeetingError, match=r"the first host has begun another run \(r2\)"):
        await asyncio.wait_for(ground.stay(), 15)
    await ground.end()
    await again.close()
    link.close()
    root.close()
