"""Finished runs, as exports find them: a site in the south, one on the 180th meridian."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.report.conftest import run_of_block, written

DIM = """<Dimap_Document><IMAGING_DATE>2013-04-17</IMAGING_DATE><IMAGING_TIME>10:32:15.5Z</IMAGING_TIME>
<SUN_AZIMUTH unit="deg">150.5</SUN_AZIMUTH><SUN_ELEVATION unit="deg">52.25</SUN_ELEVATION></Dimap_Document>"""


def _run(folder: Path, **where: float) -> Path:
    run = run_of_block(3, 300, size=(900, 700), outliers=0.03, **where)
    images = folder / "images à part"
    images.mkdir()
    (images / "north.xml").write_text(DIM)
    paths = (images / "north.tif", folder / "other" / "same.tif", folder / "twin" / "same.tif")
    views = tuple(replace(v, path=str(path)) for v, path in zip(run.views, paths, strict=True))
    written(replace(run, views=views), folder / "run")
    return folder / "run"


@pytest.fixture(scope="session")
def southern(tmp_path_factory) -> Path:
    """Three images of a place at 33 degrees south, 70 west."""
    return _run(tmp_path_factory.mktemp("south"), lon=-70.3, lat=-33.4)


@pytest.fixture(scope="session")
def on_date_line(tmp_path_factory) -> Path:
    return _run(tmp_path_factory.mktemp("dateline"), lon=180.0, lat=-16.8)


@pytest.fixture(params=["southern", "on_date_line"])
def run_dir(request) -> Path:
    return request.getfixturevalue(request.param)
