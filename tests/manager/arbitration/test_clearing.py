"""How mechanisms clear: by themselves, by an operator, or never."""

import asyncio
import dataclasses
import math

import pytest
from msgspec.structs import replace

from rampart import Arbiter, Context, verify
from rampart.actors.runtime.checkpoint_file import FileCheckpoints
from rampart.actors.supervision.node_process import OF_A_PART
from rampart.manager.actor import FtmManager
from rampart.manager.arbitration.arbiter_memory import Memory, objection, recall, remember
from rampart.manager.arbitration.arbiter_state import ResetAnswered, ResetAsked
from rampart.manager.model.mechanisms import Clears
from rampart.manager.spec.clearing import clearing_in_words, reset_role
from rampart.testing import run
from tests.manager.bench import RMS, Bench, Managed, edited, full_system


def bench(**fields) -> Bench:
    return Bench(edited(FTM2=fields))


STOPPED = "DM2 osmosis_control > +RM2; RM2 done; -DM2; wait 1.0"


CLEARING = {
    "by operator it stays until it is reset": ({"clears": Clears.BY_OPERATOR}, """
        DM2 > +RM2; RM2 done; latched: RM2; refused RM2 the cause persists: FTM2 active
        -DM2; wait 20 = RM2; active: FTM2; latched: RM2; reset RM2; wait 0.1 =; active:; latched:
        refused RM2"""),
    "by operator after the time without its error": (
        {"clears": Clears.BY_OPERATOR, "clear_after_s": 5.0}, f"""
        {STOPPED}; wait 3; refused RM2 FTM2 clears when its error has been gone for 5 s
        DM2; -DM2; wait 4.5; refused RM2; wait 10; reset RM2; wait 0.1 ="""),
    "by itself after the time without its error": ({"clear_after_s": 5.0}, f"""
        {STOPPED}; wait 3 = RM2; latched:; refused RM2; wait 3 =; active:"""),
    "never": ({"clears": Clears.NEVER}, f"""
        {STOPPED}; wait 20; refused RM2 FTM2 never clears = RM2"""),
    "not by the reset of a safer recovery that replaced its own": (
        {"clears": Clears.BY_OPERATOR}, """
        DM2 > +RM2; RM2 done; DM1; RM1 done; -DM2; -DM1; wait 1.0; latched: RM1 RM2
        reset RM1; RM1 idle; wait 0.1 = RM2; active: FTM2; RM2 done; reset RM2; wait 0.1 ="""),
}


@pytest.mark.parametrize(("fields", "script"), CLEARING.values(), ids=CLEARING)
def test_it_clears_as_specified(fields, script):
    bench(**fields).play(script)


def test_it_is_remembered_although_its_recovery_never_ran():
    """A safer recovery was in force already, and ends first."""
    run = Bench(edited(FTM1={"clears": None}, FTM4={"clears": Clears.BY_OPERATOR}))
    run.play("DM1 > +RM1; RM1 done; DM4; -DM4; wait 1.0; -DM1; wait 1.0; reset RM1; wait 0.1")
    run.play("active: FTM4; latched: RM3; reset RM3; active:")


@pytest.mark.parametrize("number", [1, 2])
def test_a_reset_that_is_older_than_the_latch_has_no_effect(number):
    run, rm = bench(clears=Clears.BY_OPERATOR), f"RM{number}"
    run.play(f"wait 1.0; DM{number}; {rm} done; -DM{number}; wait 1.0")
    answer = next(o for o in run.send(ResetAsked(rm, "late", 0.5))
                  if isinstance(o, ResetAnswered))
    assert (answer.granted, answer.reason) == (False, "the reset is older than the latch")
    run.play(f"latched: {rm}")
    assert not run.send(ResetAsked(rm, "now", run.now))[0].activate


def test_a_manager_that_is_started_again_knows_since_when_the_error_is_gone():
    run = bench(clear_after_s=5.0).play(f"{STOPPED}; wait 3")
    later = bench(clear_after_s=5.0)
    later.now = run.now
    later.state = recall(later.arbiter, remember(run.state, run.arbiter), run.now, 10_000)
    later.play("wait 0.1 = RM2; active: FTM2")  # though RM2 died too, and the error is gone
    for rm in RMS:
        later.play(f"{rm} {'done' if rm == 'RM2' else 'idle'}")
    later.play("wait 0.4 = RM2; refused RM2; wait 1.5 =")


def test_a_memory_with_an_impossible_time_is_refused():
    assert objection(Memory(1, held=(("FTM2", math.nan, 0.0),))) == \
        "FTM2 is held since nan s, seen at 0.0 s"


def test_words_about_clearing():
    words = clearing_in_words(edited(
        FTM2={"clears": Clears.BY_OPERATOR, "cleared_by": "inject", "clear_after_s": 5.0},
        FTM3={"clears": Clears.NEVER}))
    assert [words[name] for name in ("FTM1", "RM1", "FTM2", "FTM3", "FTM4")] == [
        *["clears by operator (role drive) once its error is gone"] * 2,
        "clears by operator (role inject) once its error is gone for 5 s",
        "never clears; only a new run ends it", "clears by itself once its error is gone"]


def test_a_recovery_needs_the_highest_role_of_its_mechanisms():
    spec = edited(FTM2={"clears": Clears.BY_OPERATOR, "cleared_by": "inject"})
    assert [reset_role(spec, name) for name in ("RM1", "RM2")] == ["drive", "inject"]
    assert reset_role(full_system(), "RM1") == "drive"


CLEARED = {"FTM1": {"clears": Clears.NEVER}, "FTM2": {"clears": Clears.BY_OPERATOR}}


def property_of(report):
    return next(p for p in report.properties if p.name == "cleared-as-specified")


def test_verification_covers_what_clears_and_finds_an_arbiter_that_clears_too_early(monkeypatch):
    spec = edited(**CLEARED)
    spec = replace(
        spec, mechanisms=tuple(m for m in spec.mechanisms if m.name in CLEARED),
        recoveries=tuple(r for r in spec.recoveries if r.name in {"RM1", "RM2"}),
        orders={"safer": {"RM1": ("RM2",)}})
    right = property_of(verify(spec, ["guarded-repair"]))
    assert right.holds
    assert right.cases > 100
    for name, wrong in (("_hold", lambda *_: ()), ("_refusal", lambda *_: "")):
        with monkeypatch.context() as patch:
            patch.setattr(Arbiter, name, wrong)
            found = property_of(verify(spec, ["guarded-repair"]))
        assert not found.holds
        assert found.counterexamples[0][-1].endswith("is cleared")


@pytest.mark.parametrize("clears", [Clears.BY_OPERATOR, Clears.NEVER])
def test_a_resumed_run_has_not_cleared(tmp_path, clears):
    """Its nodes have higher incarnations of the same checkpoints; its time is another one."""
    spec = replace(full_system(), mechanisms=tuple(
        replace(m, clears=clears) if m.name == "FTM13" else m for m in full_system().mechanisms))

    async def part(number: int, error: str = "", *, reset: bool = False):
        def manager(context: Context) -> FtmManager:
            return FtmManager(dataclasses.replace(context, checkpoints=FileCheckpoints(
                tmp_path, "ftm_manager", "run", number * OF_A_PART + context.incarnation)))

        async with Managed(spec, manager) as system:
            system.detect(error)
            await asyncio.sleep(2.0)
            if reset:
                await system.reset("RM8")
                await asyncio.sleep(1.0)
            return system.status

    assert run(lambda: part(0)).latched == ()
    assert run(lambda: part(1, "DM13")).latched == ("RM8",)
    status = run(lambda: part(2))
    assert (status.active, status.activated, status.latched) == (("FTM13",), ("RM8",), ("RM8",))
    status = run(lambda: part(3, reset=True))
    assert status.activated == (() if clears is Clears.BY_OPERATOR else ("RM8",))
