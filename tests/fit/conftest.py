"""Fixtures of the fit's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fit.cameras import Camera, synthetic, vendor


@pytest.fixture(scope="session")
def camera() -> Camera:
    """A synthetic P_BA over a full scene."""
    return synthetic()


@pytest.fixture(scope="session")
def vendors(shared_data: Path) -> list[Camera]:
    """P_BA of every vendor's RPC."""
    return vendor(shared_data)
