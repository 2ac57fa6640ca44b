"""A run on a radar image and two optical ones: the radar is turned and moved, an RPC is fitted to the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.base.options import AdjustOptions, RunOptions
from barpc.fit import fit_rpc
from barpc.pipeline import adjust
from barpc.pointio.matches import write_matches
from barpc.rpcio import read_rpc, write_rpc
from barpc.sensor.curve import Curve
from barpc.sensor.sicd import open_sicd
from barpc.simulate import Look, fly
from tests.everywhere import tied
from tests.geotiffs import write_blank
from tests.sensor.radar_documents import SIZE, document

TARGET, ALT = np.array([5.4, 43.3, 120.0]), (-100.0, 400.0)
STATED = "<ErrorStatistics><CompositeSCP><Rg>3</Rg><Az>3</Az></CompositeSCP></ErrorStatistics></SICD>"


@pytest.mark.slow
def test_a_radar_image_is_adjusted_beside_optical_ones(tmp_path):
    (tmp_path / "radar.xml").write_text(document("PLANE", squint=0.1).replace("</SICD>", STATED))
    radar = open_sicd(tmp_path / "radar.xml")
    truth = [
        fit_rpc(fly(TARGET, Look(12.0, azimuth), (1200, 1200), 0.5), (1200, 1200), ALT).rpc for azimuth in (10.0, 190.0)
    ]
    orbit = radar.orbit.coeffs.copy()
    orbit[:, 0] += [1.5, -1.0, 2.0]
    truth.append(replace(radar, orbit=Curve(radar.orbit.knots, orbit)))
    images = [str(write_blank(tmp_path / f"{name}.tif", (1200, 1200))) for name in "ab"]
    for image, rpc in zip(images, truth, strict=False):
        write_rpc(rpc, image.replace(".tif", "_RPC.TXT"))
    images.append(f"{write_blank(tmp_path / 'radar.tif', SIZE)},camera={tmp_path / 'radar.xml'}")
    rng, count = np.random.default_rng(2), 120
    ground = TARGET + rng.uniform(-1, 1, (2 * count, 3)) * [1.5e-3, 1.5e-3, 80.0]
    xy = np.stack([camera.project(ground) for camera in truth], axis=1)
    ties = tied(xy[:count] + rng.normal(0, 0.05, (count, 3, 2)), 0.05)
    write_matches(tmp_path / "ties.csv", ties, ["a", "b", "radar"])
    options = RunOptions(matches=str(tmp_path / "ties.csv"), matches_only=True, adjust=AdjustOptions(fixed=("a", "b")))
    result = adjust(images, tmp_path / "out", options)
    fresh = read_rpc(tmp_path / "out" / "radar_RPC.TXT")
    pixels = rng.uniform(50, np.array(SIZE) - 50, (200, 2))
    across = result.adjustment.sensors[2].localize(pixels, rng.uniform(*ALT, 200))
    np.testing.assert_allclose(fresh.project(across), result.adjustment.sensors[2].project(across), rtol=0, atol=1e-3)
    left = fresh.project(ground[count:]) - truth[2].project(ground[count:])
    assert np.sqrt((left**2).sum(axis=1).mean()) < 0.05
