"""Errors in the pixels of real images: said, followed, and the image that has them is named."""

from __future__ import annotations

import pytest

from benchmarks.planted import FOLLOWED, GOOD, Clean, clean, planted, plants


@pytest.fixture(scope="module")
def start(shared_data):
    """A set of real images as it is, run once."""
    known: dict[str, Clean] = {}

    def made(name: str) -> Clean:
        if name not in known:
            known[name] = clean(name, shared_data)
        return known[name]

    return made


@pytest.mark.slow
@pytest.mark.landing(4)
@pytest.mark.parametrize(
    ("name", "kind", "size", "view", "seed"),
    [
        ("triplet", "jump", 2.0, 0, 0),  # of the others' ties a tenth agreed, and the third was another image's
        ("triplet", "jump", 12.0, 0, 0),  # the control band shows the other rows
        ("triplet", "lost", 6.0, 0, 0),  # its grid has no place for what was lost
        ("ventoux", "detector", 3.0, 0, 0),  # with more drift no tie was left
        ("ventoux", "jump", 12.0, 1, 0),  # delivered 5 px off
        ("pair 23", "detector", 0.5, 1, 0),  # steps of both explain as much
        ("triplet", "detector", 1.0, 2, 0),
        ("triplet", "jump", 1.5, 1, 0),
        ("pair 12", "jump", 12.0, 1, 0),
    ],
)
def test_what_is_planted_is_followed_and_named(start, tmp_path, name, kind, size, view, seed) -> None:
    untouched = start(name)
    ((_, plant),) = [row for row in plants(untouched, [kind], seed) if row[0] == size and row[1].view == view]
    found = planted(untouched, plant, size, tmp_path)
    assert found.shown > GOOD  # there is something to see
    assert found.code == 3
    assert found.error <= FOLLOWED, found.line()
    assert found.worst <= GOOD, found.line()
    assert found.image in found.words[2], found.line()
