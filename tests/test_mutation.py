"""The measure of the tests itself: its mutants are changes that Python accepts, its list names what exists."""

from __future__ import annotations

import importlib.util
import random
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks/mutation.py"


@pytest.fixture(scope="module")
def mutation() -> ModuleType:
    spec = importlib.util.spec_from_file_location("mutation", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutation"] = module
    spec.loader.exec_module(module)
    return module


def test_every_listed_mutant_has_its_place_and_its_tests(mutation) -> None:
    for mutant in mutation.chosen():
        before, after = mutant.source()
        assert before != after
        compile(after, mutant.file, "exec")
        for pattern in mutation.TESTS[mutant.part].split():
            assert list(SCRIPT.parents[1].glob(pattern))


def test_mutants_are_programs_that_differ(mutation) -> None:
    every = mutation.mutants([*mutation.TESTS])
    assert {mutant.part for mutant in every} == set(mutation.TESTS)
    for mutant in random.Random(0).sample(every, 60):
        before, after = mutant.source()
        assert before != after
        compile(after, mutant.file, "exec")


def test_mutants_named_equivalent_are_still_there(mutation) -> None:
    listed = mutation.equivalents()
    files = {file for file, _ in listed}
    every = [mutant for mutant in mutation.mutants([*mutation.TESTS]) if mutant.file in files]
    known = {(mutant.file, mutation.changed(mutant)) for mutant in every}
    assert set(listed) <= known


def test_the_score_leaves_out_equivalents(mutation) -> None:
    fates = ["caught"] * 8 + ["SURVIVED"] * 2 + ["equivalent"] * 5
    rows = [{"part": "ba", "fate": fate, "diff": str(n)} for n, fate in enumerate(fates)]
    found = mutation.score(rows)
    assert found["score"]["ba"] == {"caught": 8, "SURVIVED": 2, "equivalent": 5, "share": 0.8}
    assert found["survivors"] == ["8", "9"]
