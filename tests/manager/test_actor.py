"""The FTM Manager among modules on one virtual bus, and changes of its system while it runs."""

import asyncio
import copy
from functools import partial

import msgspec
import pytest

from rampart.actors.detection.stub import StubDetection
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.machine.absence import GRACE_S
from rampart.manager.spec.adaptation import (
    Action,
    Change,
    ChangeError,
    adapt,
    changed_actors,
    parse_value,
)
from rampart.manager.spec.specification import SpecificationError, SystemSpec, read_document
from rampart.sim.virtual.virtual_loop import VirtualLoop
from rampart.testing import turns
from tests.manager.bench import PAPER, Managed, paper
from tests.virtual_time import within


@within(Managed)
async def test_an_emergency_stop_comes_with_the_report_and_stays_until_it_is_reset(system):
    system.detect("DM1")
    await system.settle()
    assert system.taken == [(("FTM1",), 1, ("RM1",))]
    await system.reset("RM1")
    told, = (one.message for one in system.problems)
    assert (told.context, told.reason) == ("reset refused", "the cause persists: FTM1 active")
    system.detect()
    await asyncio.sleep(5.0)
    assert (system.status.activated, system.status.latched) == (("RM1",), ("RM1",))
    await system.reset("RM1")
    assert (system.status.activated, system.status.latched) == ((), ())


@within(Managed)
async def test_a_detection_module_that_lives_and_is_not_heard_is_replaced_once(system):
    timeout_s = system.run.system.timing.detection_silence_timeout_s
    hung_s = system.clock.now()
    system.actors["DM3"].hold(True)
    await asyncio.sleep(3.0)
    asked, = system.respawns
    assert 0.4 * timeout_s < asked.time_s - hung_s < 0.75 * timeout_s
    assert (asked.message.node, asked.message.failed_incarnation, asked.message.by) == (
        "DM3", 1, "ftm_manager")
    assert system.status.silent == ("DM3",)
    await system.kill("DM3")
    again = system.start("DM3", StubDetection)
    await asyncio.sleep(2.0)
    assert system.status.silent == ()
    again.hold(True)
    await asyncio.sleep(2.0)
    assert [(r.message.request, r.message.node, r.message.failed_incarnation)
            for r in system.respawns] == [(1, "DM3", 1), (2, "DM3", 2)]


@within(Managed)
async def test_a_respawned_manager_adopts_a_latched_emergency_stop(system):
    system.detect("DM1")
    await asyncio.sleep(0.5)
    await system.kill("ftm_manager")
    system.detect()
    await asyncio.sleep(2.0)
    system.start_manager()
    for _ in range(100):
        await asyncio.sleep(0.05)
        assert system.actors["RM1"].activated
    assert system.status.latched == ("RM1",)
    await system.reset("RM1")
    assert not system.actors["RM1"].activated


@within(Managed)
async def test_a_manager_that_was_stopped_takes_nobodys_unread_mail_for_silence(system):
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    for pause_s in (0.31, 0.4, 0.5, 0.7, 1.1, 5.0):
        loop.jump(pause_s)
        await asyncio.sleep(2.0)
    assert not any(status.message.silent for status in system.statuses)
    assert system.decisions == []


@within(Managed)
async def test_a_manager_that_was_stopped_waits_for_modules_that_go_on_after_it(system):
    for actor in system.actors.values():
        actor.hold(True)
    await asyncio.sleep(5.0)
    system.actors["ftm_manager"].hold(False)
    await asyncio.sleep(0.8 * GRACE_S)
    for actor in system.actors.values():
        actor.hold(False)
    await asyncio.sleep(2.0)
    assert system.decisions == []
    assert system.respawns == []
    system.actors["DM6"].hold(True)
    await asyncio.sleep(2.0)
    assert "DM6" in system.status.silent


# -- changes while running: what is made of a document


DOCUMENT = read_document(PAPER, "paper.toml")


def change(action: str, name: str, /, **values) -> SystemSpec:
    before = copy.deepcopy(DOCUMENT)
    _, spec = adapt(DOCUMENT, Change(Action(action), name, values), "paper.toml")
    assert before == DOCUMENT
    return spec


@pytest.mark.parametrize(("name", "left_out"), [
    ("FTM7", {"FTM7"}), ("DM4", {"FTM4"}), ("FTM3", {"FTM3"})])
def test_what_is_disabled_is_left_out_with_all_that_uses_it_until_it_is_enabled(name, left_out):
    after, spec = adapt(DOCUMENT, Change(Action.DISABLE, name), "f")
    kept = {mechanism.name for mechanism in spec.mechanisms}
    assert {mechanism.name for mechanism in paper().mechanisms} - kept == left_out
    _, spec = adapt(after, Change(Action.ENABLE, name), "f")
    assert spec.build_ftm_tree().parents == paper().build_ftm_tree().parents


def test_a_parameter_is_retuned_and_only_that_module_has_to_be_started_anew():
    spec = change("retune", "DM1", margin_m=0.7)
    assert next(d for d in spec.detections if d.name == "DM1").parameters["margin_m"] == 0.7
    assert changed_actors(paper(), spec) == ("DM1",)
    assert changed_actors(paper(), change("retune", "RM3", deadline_s=2.5)) == ()
    assert changed_actors(paper(), change(
        "retune", "DM3", actor="rampart.actors.detection.stub:StubDetection")) == ("DM3",)


def test_a_gate_and_an_order_and_a_strategy_are_changed():
    assert change("retune", "FTM2", detect="DM2 or DM6").mechanisms[1].detections == ("DM2", "DM6")
    assert change("set", "strategy", value="mission-first").strategy == "mission-first"


@pytest.mark.parametrize(("action", "name", "values", "message"), [
    ("disable", "FTM9", {}, "unknown detection module, recovery module or mechanism 'FTM9'"),
    ("retune", "FTM3", {}, "retune FTM3: expected fields and their new values"),
    ("retune", "FTM3", {"name": "X"}, "name = 'X': a name cannot be changed"),
    ("replace", "DM1", {"parameters": 3}, "detection DM1: parameters = 3: expected a table"),
    ("replace", "FTM3", {"name": "X"}, "name = 'X': a replacement keeps the name, 'FTM3'"),
    ("set", "airport", {"value": "x"}, "unknown setting 'airport'; known: strategy, shadow, order"),
    ("set", "strategy", {}, "set strategy: expected a value"),
    ("set", "strategy", {"value": "bold"}, "$.strategy = 'bold': unknown strategy; known: "),
    ("disable", "RM1", {}, "recovery RM2: escalate_to = 'RM1': expected an enabled"),
    ("disable", "DM2", {}, "FTM4 needs 0.990 s"),  # it would have to be faster than DM1
    ("retune", "DM2", {"parameters": None, "value": None}, "parameters = None: expected a table"),
])
def test_refused_in_one_line(action, name, values, message):
    with pytest.raises((ChangeError, SpecificationError)) as caught:
        change(action, name, **values)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("text", "value"), [
    ("0.5", 0.5), ("[1, 2]", [1, 2]), ("'a b'", "a b"), ("2 of (DM1, DM2)", "2 of (DM1, DM2)")])
def test_values_are_read_as_toml_and_words_as_text(text, value):
    assert parse_value(text) == value
    for neither in ("{;}", "+" + "9" * 5000, "[" * 5000):
        with pytest.raises(ChangeError, match="expected a TOML value"):
            parse_value(neither)


# -- and what the manager does with it


class Adaptable(Managed):
    """The manager, which is asked for changes."""

    def __init__(self, **plan) -> None:
        super().__init__(document=copy.deepcopy(DOCUMENT), **plan)
        self.answers, self.systems, self.shadows = map(self.hear, (
            topics.ADAPTATION, topics.ADAPTED_SYSTEM, topics.SHADOW))

    async def ask(self, action: str, name: str, values: str = "{}") -> m.AdaptationAnswer:
        count = len(self.answers)
        self.say(topics.ADAPT, m.AdaptationRequest("r", action, name, values, "test"))
        await turns()
        assert len(self.answers) == count + 1
        return self.answers[-1].message


@within(Adaptable)
async def test_a_change_is_applied_at_once_told_whole_and_repeated_and_nothing_else_happens(system):
    answer = await system.ask("set", "strategy", '{"value": "guarded-repair"}')
    assert (answer.accepted, answer.reason, answer.version) == (True, "", 1)
    told = system.systems[-1].message
    assert (told.version, told.change) == (1, "set strategy to 'guarded-repair'")
    assert msgspec.json.decode(told.document)["strategy"] == "guarded-repair"
    assert system.status.strategy == "guarded-repair"
    count = len(system.systems)
    await asyncio.sleep(5.0)
    assert len(system.systems) >= count + 4
    assert system.decisions == []  # belief in all modules was kept


@within(Adaptable)
async def test_the_new_strategy_decides_from_then_on(system):
    await system.ask("set", "strategy", '{"value": "guarded-repair"}')
    await system.ask("set", "shadow", '{"value": "safety-first"}')
    system.detect("DM2")
    await asyncio.sleep(0.3)
    system.detect("DM2", "DM4")
    await asyncio.sleep(0.3)
    assert (("FTM2", "FTM4"), 2, ("RM2", "RM3")) in system.taken
    assert any(s.message.strategy == "safety-first" and s.message.recoveries == ("RM2",)
               for s in system.shadows)


@within(Adaptable)
async def test_in_the_middle_of_a_recovery_it_is_refused_and_afterwards_it_is_not(system):
    system.detect("DM2")
    await asyncio.sleep(1.5)
    answer = await system.ask("disable", "FTM7")
    assert not answer.accepted
    assert answer.reason.startswith("not in the middle of a recovery: RM2")
    system.detect()
    await asyncio.sleep(2.0)
    assert (await system.ask("disable", "FTM7")).accepted


REFUSED = [
    ("explode", "FTM7", "{}", "'explode' is not a valid Action"),
    ("disable", "FTM7", "[]", "Expected `object`"),
    ("set", "strategy", '{"value": ' + 5000 * "[" + 5000 * "]" + "}", ""),
    ("set", "strategy", '{"value": NaN}', ""), ("set", "strategy", "\xff", ""),
    ("retune", "DM1", '{"actor": "rampart.actors.osmosis.detection.bounds:Nobody"}',
     "no such actor class"),
    ("retune", "DM3", '{"actor": "rampart.actors.osmosis.recovery.emergency_stop:EmergencyStop"}',
     "it does not publish detection/{name}"),
    ("retune", "DM3", '{"actor": "rampart.actors.detection.stub:StubDetection"}',
     "expected a class in a module that the running system uses"),
    ("retune", "DM5", '{"process": "DM1"}', "DM5: process = 'DM1': expected 'DM5', which stays"),
    ("retune", "DM99", '{"margin_m": 0.7}', "unknown detection module, recovery module or mechani"),
]


@within(Adaptable)
async def test_what_is_refused_changes_nothing(system):
    for action, name, values, words in REFUSED:
        answer = await system.ask(action, name, values)
        assert not answer.accepted
        assert words in answer.reason
        assert "\n" not in answer.reason
    assert system.systems == []
    system.detect("DM2")
    await asyncio.sleep(1.5)
    assert system.taken == [(("FTM2",), 1, ("RM2",))]


@within(partial(Adaptable, keys="keys"))
async def test_with_credentials_a_change_that_they_do_not_permit_is_refused(system):
    answer = await system.ask(
        "retune", "DM5", '{"watch": ["hmi", "teleoperation", "localization"]}')
    assert not answer.accepted
    assert answer.reason.startswith("DM5: would need other topics")
    assert (await system.ask("retune", "DM1", '{"margin_m": 0.7}')).accepted
