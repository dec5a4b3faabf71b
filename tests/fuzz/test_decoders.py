"""Each decoder accepts an input or refuses it with its documented error, within the limits."""

import contextlib
from functools import cache

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.fuzz import target, targets  # noqa: F401 they register
from tests.fuzz.target import ALL, CORPUS, LAST, SlowError, Target, UnsoundError, inputs

pytestmark = pytest.mark.filterwarnings("ignore:Generating overly large repr")

PAST = [(one, path) for one in ALL.values() for path in one.corpus()]


@pytest.mark.parametrize(("decoder", "path"), PAST, ids=[f"{t.name}-{p.name}" for t, p in PAST])
def test_past_findings_are_accepted_or_refused(decoder, path):
    decoder.try_input(path.read_bytes())


@cache
def pool(decoder):
    return [*decoder.samples(), *(path.read_bytes() for path in decoder.corpus())]


@pytest.mark.parametrize("decoder", ALL.values(), ids=ALL)
@settings(suppress_health_check=list(HealthCheck), phases=set(Phase) - {Phase.explain})
@given(st.data())
def test_changed_samples_are_accepted_or_refused(decoder, data):
    drawn = data.draw(inputs(pool(decoder), decoder.form, decoder.words))
    try:
        decoder.try_input(drawn)
    except Exception as error:
        error.add_note(f"the input is in {LAST / decoder.name}; keep it in {CORPUS / decoder.name}")
        raise


@pytest.mark.parametrize("decoder", ALL.values(), ids=ALL)
def test_samples_are_accepted(decoder):
    assert any([decoder.try_input(data) for data in decoder.samples()])  # noqa: C419 all of them run


def test_every_corpus_has_its_target():
    assert {path.name for path in CORPUS.iterdir()} <= set(ALL)


# -- the limits themselves -------------------------------------------------------------------------


def hang(_data):
    with contextlib.suppress(Exception):
        while True:
            pass


def refuse_in_two_lines(_data):
    raise ValueError("two\nlines")


@pytest.mark.parametrize(("run", "finding"), [
    ({}.__getitem__, KeyError), (refuse_in_two_lines, UnsoundError), (hang, SlowError),
    (lambda _data: bytearray(1 << 30), MemoryError)])
def test_unexpected_errors_long_times_and_much_memory_are_findings(
        run, finding, monkeypatch, tmp_path):
    monkeypatch.setattr(target, "LIMIT_S", 0.1)
    monkeypatch.setattr(target, "LAST", tmp_path)
    decoder = Target("sick", run, (ValueError,), list, "binary", (), one_line=True)
    with pytest.raises(finding):
        decoder.try_input(b"abc")
    bytearray(600 << 20)
