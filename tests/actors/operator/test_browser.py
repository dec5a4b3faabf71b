"""Without a browser the page is not tested: a reason to skip, or a failure where it has to be."""

from __future__ import annotations

import pytest

from tests import conftest


@pytest.mark.parametrize(("asked", "outcome"), [("", pytest.skip.Exception),
                                                ("1", pytest.fail.Exception)])
def test_without_chromium_a_test_of_the_page_is_skipped_or_fails(
        request, monkeypatch, asked, outcome):
    monkeypatch.setitem(conftest.WANTING, "page", (False, *conftest.WANTING["page"][1:]))
    monkeypatch.setenv("RAMPART_TEST_PAGE", asked)
    conftest.pytest_runtest_setup(request.node)
    request.node.add_marker("page")
    with pytest.raises(outcome, match="no Chromium: `apt-get install chromium` brings it"):
        conftest.pytest_runtest_setup(request.node)
