"""Benchmarks name functions of the package that exist: their own lane is the slowest."""

from __future__ import annotations

import pytest

from benchmarks.ablation import MECHANISMS, Mechanism


@pytest.mark.parametrize("name", MECHANISMS)
def test_a_mechanism_that_is_switched_off_is_there(name: str) -> None:
    assert all(callable(getattr(target, function)) for target, function in Mechanism(name).places())
