"""Examples in docstrings run in a folder of their own, with the repository's images in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import barpc

pytest_plugins = ["pytester", "tests.costs"]

WAITS = {"barpc.verbs.runs.export": ("slow",), "barpc.verbs.runs.dsm": ("slow", "nightly")}
"""Marks of examples of several whole runs."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Examples that take seconds wait for a slower lane."""
    for item in items:
        for mark in WAITS.get(item.name, ()):
            item.add_marker(mark)


@pytest.fixture(autouse=True)
def _an_example_s_folder(request: pytest.FixtureRequest, doctest_namespace: dict[str, Any]) -> None:
    """A doctest has `barpc` and `np`, and writes nowhere else."""
    if isinstance(request.node, pytest.DoctestItem):
        doctest_namespace.update(barpc=barpc, np=np)
        folder = request.getfixturevalue("tmp_path")
        (folder / "data_samples").symlink_to(Path(__file__).parent / "data_samples")
        request.getfixturevalue("monkeypatch").chdir(folder)
