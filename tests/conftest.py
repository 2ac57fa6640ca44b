"""What every test may ask for: the shared data, where it is present."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import constants
from tests.lanes import spread

os.environ.setdefault("OMP_NUM_THREADS", "1")

SHARED = Path(os.environ.get("BARPC_SHARED", Path(__file__).resolve().parents[2] / "shared"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real images and truth; a test that needs it is skipped where it is absent."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"no shared data at {folder} (set BARPC_SHARED)")
    return folder


sized = pytest.fixture(constants.sized)
"""Sets sizes of `tests.constants.SIZES`."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """What `-n auto` takes: many tests wait for a process, a host or a disk. Neighbours stay with one worker, which
    makes what they share once."""
    if config.option.dist == "no":
        config.option.dist = "worksteal"
    return max(2, (os.cpu_count() or 1) * 3 // 2)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """What is collected stays: the garbage collector need not look through it, now or beside the tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`few(n)`, `landing(n)`: all but n members of a kind wait for the next lane; what is nightly is slow, too."""
    for mark, wait in (("few", "slow"), ("landing", "nightly")):
        kinds: dict[str, list[pytest.Item]] = {}
        for item in items:
            if item.get_closest_marker(mark) and not any(map(item.get_closest_marker, {wait, "nightly"})):
                kinds.setdefault(item.nodeid.partition("[")[0], []).append(item)
        for members in kinds.values():
            few = members[0].get_closest_marker(mark)
            assert few is not None
            kept = spread(len(members), *few.args)
            for number, item in enumerate(members):
                if number not in kept:
                    item.add_marker(wait)
    for item in items:
        if item.get_closest_marker("nightly"):
            item.add_marker(pytest.mark.slow)
