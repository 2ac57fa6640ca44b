"""A test that costs more than its lane allows is told by name."""

from __future__ import annotations

import pytest

from tests.costs import allowed

MOST = 120.0  # CPU seconds of all cases at a landing that say that they take longer

CASES = """
import pytest, time
def busy(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end: pass
@pytest.fixture(scope="module")
def made(): busy(0.15)
def test_cheap(made): pass
def test_dear(): busy(0.15)
@pytest.mark.costs(1)
def test_telling(): busy(0.15)
@pytest.mark.nightly
def test_at_night(): busy(0.15)
"""


@pytest.mark.parametrize("how", ["tell", "hold"])
def test_what_costs_more_than_its_lane_allows_is_told(pytester: pytest.Pytester, monkeypatch, how: str) -> None:
    monkeypatch.setattr("tests.costs.BUDGET", 0.05)
    pytester.makeini("[pytest]\nmarkers = nightly\n  costs\n")
    pytester.makepyfile(CASES)
    found = pytester.runpytest_inprocess("-p", "tests.costs", "-p", "no:xdist", "--cpu", how)
    found.assert_outcomes(passed=4, errors=int(how == "hold"))
    found.stdout.fnmatch_lines(["*CPU seconds: * in 4 tests*", "0.* test_what*::test_*"])
    if how == "hold":
        found.stdout.fnmatch_lines(["*0.[1-9] CPU s, 0.05 are allowed*", "ERROR *::test_dear*"])


def test_a_shared_fixture_has_a_budget_of_its_own(pytester: pytest.Pytester, monkeypatch) -> None:
    monkeypatch.setattr("tests.costs.SHARED", 0.05)
    pytester.makeini("[pytest]\nmarkers = nightly\n  costs\n")
    pytester.makepyfile(CASES)
    found = pytester.runpytest_inprocess("-p", "tests.costs", "-p", "no:xdist", "--cpu", "hold")
    found.assert_outcomes(passed=3, errors=1)
    found.stdout.fnmatch_lines(["*made, shared: 0.[1-9] CPU s, 0.05 are allowed*"])


def test_parts_are_all_tests_together_and_what_is_not_begun_in_time_is_said(pytester: pytest.Pytester) -> None:
    pytester.makeini("[pytest]\n")
    pytester.makepyfile("import pytest\n@pytest.mark.parametrize('k', range(12))\ndef test_one(k): pass")
    how = ("-p", "tests.costs", "-p", "no:xdist", "-rs")
    parts = [pytester.runpytest_inprocess(*how, "--part", f"{7 + k}/2").parseoutcomes() for k in range(2)]
    assert sum(part["passed"] for part in parts) == 12
    assert max(part["passed"] for part in parts) < 12
    found = pytester.runpytest_inprocess(*how, "--minutes", "0")
    found.assert_outcomes(skipped=12)
    found.stdout.fnmatch_lines(["SKIPPED *not begun in 0 minutes"])


def test_the_cases_that_take_longer_are_bounded_together(request: pytest.FixtureRequest) -> None:
    longer = [item for item in request.session.items if item.get_closest_marker("costs")]
    assert sum(allowed(item) for item in longer if not item.get_closest_marker("nightly")) <= MOST
