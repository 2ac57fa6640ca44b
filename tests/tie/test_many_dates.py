"""Many dates of one place: the pairs chosen tie all of them as exactly as images allow, and are as many as these.

A hundred of such dates, by `benchmarks/dates.py`: 0.0163 px RMS, 726 pairs.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import date, timedelta

import numpy as np
import pytest

from barpc.base.options import RunOptions, TieOptions
from barpc.pipeline import adjust
from benchmarks.dates import block

DATES, SEASONS, NEIGHBOURS = 40, 4, 8


@pytest.mark.nightly
def test_forty_dates_of_four_seasons_a_third_of_them_under_clouds_agree(tmp_path) -> None:
    years = block(DATES, 0, 0, 400, 0.3, SEASONS)
    assert sum(share > 0 for share in years.clouds) == DATES // 3
    days = [date(2015 + k % 5, 1, 1) + timedelta(int(365 * phase)) for k, phase in enumerate(years.phases)]
    views = [replace(v, date=str(d)) for v, d in zip(years.write(tmp_path), days, strict=True)]
    result = adjust(views, tmp_path / "out", RunOptions(tie=TieOptions(neighbours=NEIGHBOURS)))
    assert [view.name for view in result.views] == [view.name for view in views]
    errors = years.errors([view.sensor for view in result.views])
    assert np.median(years.errors(years.delivered)) > 3
    assert np.sqrt((errors**2).mean()) < 0.03
    assert errors.max() < 0.06
    # of all 780: its partners are shared with others, and a few lead to other groups of views
    assert len(result.run.matched) <= DATES * NEIGHBOURS
