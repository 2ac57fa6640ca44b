"""What each test costs, and a part of a lane that is too long for one landing.

Costs are told with `--cpu tell`, and with `--cpu hold` are no more than the lane allows.

An item may take `BUDGET` CPU seconds, its children's with them; one with the mark `costs(n)` n of them, one that waits
for the nightly lane as many as it likes. What several items share (a fixture that is not of one function) is charged
to none of them, and may take `SHARED` seconds.

`--part 17/12` runs a twelfth of the tests, the next number another one; what has not begun after `--minutes` is skipped
with that reason.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterator

import pytest

from tests.lanes import in_turn

BUDGET, SHARED = 2.0, 10.0
SLACK = 2.0
"""A test is told at twice what it may take: CPU seconds are half as many again where other work takes all cores."""
SPENT = pytest.StashKey[float]()
BEGAN = time.monotonic()
shared = 0.0  # CPU seconds of fixtures that several items share


def cpu() -> float:
    """CPU seconds of this process and of the children that it waited for."""
    return sum(os.times()[:4])


def allowed(item: pytest.Item) -> float:
    """CPU seconds that a test may take."""
    mark = item.get_closest_marker("costs")
    return float("inf") if item.get_closest_marker("nightly") else float(mark.args[0]) if mark else BUDGET


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--cpu", choices=("tell", "hold"), help="CPU seconds of folders and tests; hold: of a budget")
    parser.addoption("--part", metavar="NUMBER/PARTS", help="a part of the tests, another one with the next number")
    parser.addoption("--minutes", type=float, default=float("inf"), help="of these the part that is begun in so many")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.option.part:
        by_name = {item.nodeid: item for item in items}
        kept = in_turn(by_name, config.option.part)
        config.hook.pytest_deselected(items=[item for name, item in by_name.items() if name not in set(kept)])
        items[:] = [by_name[name] for name in kept]


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest) -> Iterator[None]:
    global shared
    before, others = cpu(), shared
    try:
        return (yield)
    finally:
        if fixturedef.scope != "function":
            seconds = cpu() - before - (shared - others)
            shared += seconds
            if seconds > SLACK * SHARED and request.config.option.cpu == "hold":
                pytest.fail(f"{fixturedef.argname}, shared: {seconds:.1f} CPU s, {SHARED:g} are allowed", False)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[SPENT] = cpu() - shared
    if time.monotonic() - BEGAN > 60.0 * item.config.option.minutes:
        pytest.skip(f"not begun in {item.config.option.minutes:g} minutes")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    done = yield
    seconds, most = cpu() - shared - item.stash[SPENT], allowed(item)
    item.user_properties.append(("cpu", seconds))
    if seconds > SLACK * most and item.config.option.cpu == "hold":
        pytest.fail(f"{seconds:.1f} CPU s, {most:g} are allowed: a smaller case, or `costs(n)`, or `nightly`", False)
    return done


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if not config.option.cpu:
        return
    told = [one for kind in terminalreporter.stats.values() for one in kind]
    reports = [one for one in told if getattr(one, "when", "") == "teardown" and one.user_properties]
    costs = sorted((dict(one.user_properties)["cpu"], one.nodeid) for one in reports)
    folders: Counter[str] = Counter()
    for seconds, name in costs:
        folders["/".join(name.split("::")[0].split("/")[:-1])] += seconds
    terminalreporter.section(f"CPU seconds: {sum(folders.values()):.0f} in {len(costs)} tests")
    for name, seconds in folders.most_common():
        terminalreporter.line(f"| {name} | {seconds:.1f} |")
    for seconds, name in costs[:-21:-1]:
        terminalreporter.line(f"{seconds:.1f} {name}")
