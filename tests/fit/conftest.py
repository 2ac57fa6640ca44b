"""Fixtures of the fit's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fit.cameras import Camera, synthetic, vendor
from tests.lanes import rest_slow


@pytest.fixture(scope="session")
def camera() -> Camera:
    """A synthetic P_BA over a full scene."""
    return synthetic()


@pytest.fixture(scope="session")
def vendors(shared_data: Path) -> list[Camera]:
    """P_BA of every vendor's RPC."""
    return vendor(shared_data)


@pytest.fixture(params=rest_slow([0, 1, 2]))
def some_vendors(request: pytest.FixtureRequest, vendors: list[Camera]) -> list[Camera]:
    """A third of the vendors' cameras: before a commit one of them."""
    return vendors[request.param :: 3]
