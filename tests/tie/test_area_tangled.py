"""An area of interest whose outline crosses itself: untangled, or refused where that would take hours."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.tie.pairing.area import read_area


def an_area(folder: Path, *rings: np.ndarray) -> Path:
    """A file of a polygon with these rings."""
    path = folder / "area.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [np.vstack([r, r[:1]]).tolist() for r in rings]}))
    return path


def test_an_outline_that_crosses_itself_is_two_areas(tmp_path):
    bow = read_area(an_area(tmp_path, np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])))
    inside = np.array([[0.9, 0.5], [0.1, 0.5], [0.5, 0.9], [0.5, 0.1]])
    assert bow.contains(inside).tolist() == [True, True, False, False]


def test_an_outline_is_untangled_of_as_many_crossings_as_allowed_and_no_more(tmp_path, sized):
    star = np.array([[np.sin(k * 0.8 * np.pi), np.cos(k * 0.8 * np.pi)] for k in range(5)])  # five crossings
    sized(sides_crossed=5)
    read_area(an_area(tmp_path, star))
    sized(sides_crossed=4)
    with pytest.raises(InputError, match="an outline crosses itself more than 4 times"):
        read_area(an_area(tmp_path, star))
    sized(sides_together=1)  # found from both sides of a side, whatever is looked at together
    with pytest.raises(InputError, match="more than 4 times"):
        read_area(an_area(tmp_path, star))
    sized(sides_crossed=0)
    read_area(an_area(tmp_path, np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])))


@pytest.mark.slow
def test_a_tangle_is_refused_at_once(tmp_path):
    tangle = np.random.default_rng(0).uniform(0.0, 1.0, (5000, 2))
    start = time.process_time()
    with pytest.raises(InputError, match="crosses itself more than 2000 times"):
        read_area(an_area(tmp_path, tangle))
    assert time.process_time() - start < 20.0  # CPU s; some tenths on a machine of its own, and else days
