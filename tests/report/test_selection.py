"""What the report's script does, in a real browser: one selection everywhere, filters, residual maps in large."""

from __future__ import annotations

import pytest

from .test_chromium import CHROMIUM, page, probe

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt-get install chromium)"),
]
pytest.importorskip("jinja2")


@pytest.fixture(scope="module")
def found(block_run, tmp_path_factory) -> dict:
    return probe(page(block_run), 1200, tmp_path_factory.mktemp("driver"), by="selection.js")


@pytest.fixture(scope="module")
def pair(block_run) -> dict:
    """The pair of the first two images."""
    return next(p for p in block_run.summary["pairs"] if {p["a"], p["b"]} == {"view_0000", "view_0001"})


def test_nothing_goes_wrong(found):
    assert found["errors"] == []


def test_an_outline_that_is_clicked_is_chosen_in_the_tables_and_not_when_clicked_again(found, block_run):
    lit, rows, said = found["map"]
    partners = [p for p in block_run.summary["pairs"] if "view_0002" in (p["a"], p["b"])]
    assert lit == ["2"]
    assert [row for row in rows if row.startswith("t-images")] == ["t-images view_0002"]
    assert len([row for row in rows if row.startswith("t-pairs")]) == len(partners)
    assert said == f"view_0002: {block_run.summary['views'][2]['num_observations']} tie points used"
    assert found["again"] == [[], [], ""]


def test_a_row_of_a_pair_chooses_both_its_images(found, pair):
    lit, rows, said = found["pair"]
    assert sorted(lit) == ["0", "1"]
    assert [row for row in rows if row.startswith("t-images")] == ["t-images view_0000", "t-images view_0001"]
    assert [row for row in rows if row.startswith("t-pairs")] == ["t-pairs view_0000 - view_0001"]
    assert said == f"view_0000 - view_0001: {pair['num_matches']} tie points used"
    assert found["cleared"] == [[], [], ""]


def test_keys_walk_and_choose(found):
    assert found["focus"] == "view_0001"
    assert found["keyed"][0] == ["1"]
    assert found["keyed"][1].startswith("view_0001")


def test_a_filter_keeps_the_rows_that_have_its_words(found):
    assert found["filtered"] == ["view_0003"]
    assert found["count"] == "1 of 9 rows"


def test_a_residual_map_opens_in_large(found):
    assert found["dialog"] == [True, True, True]
    assert found["closed"] is False
