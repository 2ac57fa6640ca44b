"""How far a pair is searched: as far as its cameras may be wrong in metres, at a bounded cost."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import rowcol
from rasterio.warp import transform

from barpc.base.geodesy import Array
from barpc.pipeline.loading import load_views
from barpc.tie import TieOptions, find_tracks
from barpc.tie.matchers import structural
from barpc.tie.matchers.features import join_keypoints
from barpc.tie.matchers.pair_search import PairSearch
from barpc.tie.pairing.epipolar import epipolar_segments
from barpc.tie.pairing.overlaps import reach_of
from barpc.tie.patches.oriented import PatchTile
from tests.constants import Sized
from tests.geotiffs import write_image
from tests.lanes import rest_slow
from tests.tie.stages import common_tracks, part_of

from .test_pairs import METRE, camera, views

GEOID = 28.2
"""Above the ellipsoid there [m], by EGM96."""


@pytest.mark.parametrize(
    ("pixel", "asked", "reach"),
    [
        (0.3, None, 700.0), (1.0, None, 700.0), (2.0, None, 350.0), (10.0, None, 70.0), (60.0, None, 20.0),
        (10.0, 700.0, 700.0), (0.5, 12.0, 12.0),
    ],
)  # fmt: skip
def test_a_camera_may_be_wrong_by_so_many_metres_whatever_its_pixel(pixel, asked, reach) -> None:
    (view,) = views(camera(0.0, lean=0.0).window(0, 0, 2 * pixel, 2 * pixel))
    assert reach_of(view, asked) == pytest.approx(reach, rel=0.01)


def test_the_pixel_is_that_in_the_middle_of_the_image() -> None:
    """Of a camera of 10 m whose pixels grow over its columns."""
    rpc = camera(0.0, lean=0.0)
    rpc = replace(rpc, ground_scale=rpc.ground_scale * [20.0, 20.0, 1.0])
    coeffs = rpc.coeffs.copy()
    coeffs[1, 1] = coeffs[3, 1] = -0.5
    (view,) = views(replace(rpc, coeffs=coeffs))
    (plain,) = views(rpc)
    assert reach_of(view, None) == pytest.approx(reach_of(plain, None), rel=0.01)
    assert reach_of(plain, None) == pytest.approx(70.0, rel=0.01)


def test_a_camera_that_sees_no_ground_is_searched_as_far_as_any() -> None:
    (view,) = views(camera(0.0).crop(1e12, 0.0))
    assert reach_of(view, None) == 700.0


class Pinhole:
    """A frame camera 3 km above a point, looking down, half a metre a pixel."""

    def project(self, ground: Array) -> Array:
        return 499.5 + ground[..., :2] / METRE * [6000.0, -6000.0] / (3000.0 - ground[..., 2:])

    def localize(self, image: Array, alt: Array) -> Array:
        lonlat = (image - 499.5) * [METRE, -METRE] / 6000.0 * (3000.0 - alt[..., None])
        return np.concatenate([lonlat, alt[..., None]], axis=-1)

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        steps = [(self.project(ground + step) - self.project(ground - step)) for step in np.diag([METRE, METRE, 1.0])]
        return self.project(ground), np.stack(steps, axis=-1) / (2 * np.array([METRE, METRE, 1.0]))


def test_segments_around_an_epipole_stay_near_their_points() -> None:
    """A frame camera above what a satellite sees straight below: points move away from the middle as they grow."""
    below, above = views(camera(0.0, lean=0.0)), replace(*views(camera(0.0)), sensor=Pinhole())
    xy = np.random.default_rng(1).uniform(0, 999, (500, 2))
    where = epipolar_segments(above, below[0], xy)
    assert (np.abs(where.slope) <= 1.0).all()
    ends = np.stack([where.place(where.before - 700.0), where.place(where.after + 700.0)])
    assert np.abs(ends - xy).max() < 1.5 * 750.0  # 1000 times that without a bound
    along = np.abs(np.degrees(np.arctan2(*(xy - 499.5).T[::-1])) % 180.0)
    axis = np.degrees(np.arctan2(where.axis[1], where.axis[0])) % 180.0
    near = np.abs((along - axis + 90.0) % 180.0 - 90.0) < 40.0
    assert near.sum() > 100
    top = below[0].sensor.project(above.sensor.localize(xy[near], np.full(near.sum(), 200.0)))
    assert np.abs(part_of(where, near).errors(top)[:, 1]).max() < 1e-6  # along the axis they are as they were


@pytest.mark.slow
def test_a_search_in_parts_finds_what_a_search_in_one_finds(monkeypatch, sized: Sized, scene) -> None:
    """Bands without votes: every point is looked for alone; how many are correlated together changes nothing."""
    options = TieOptions(matcher="structure", search=20.0)
    search = PairSearch(tuple(scene.views), (join_keypoints([]), join_keypoints([])), options)
    coarse = search.offset
    assert coarse is not None
    whole = structural._GridSearch(*scene.views, 1, coarse).matches()
    sizes, of = [], PatchTile.surfaces

    def watched(self):
        found = of(self)
        sizes.append(found.size)
        return found

    monkeypatch.setattr(PatchTile, "surfaces", watched)
    sized(places_together=30_000)
    sized(windows_together=20_000)
    parts = structural._GridSearch(*scene.views, 1, coarse).matches()
    assert len(sizes) >= 8
    assert max(sizes) <= 60_000
    assert len(parts) == len(whole) > 100
    order = [np.lexsort(found.xy[:, 0].T) for found in (whole, parts)]
    apart = np.abs(whole.xy[order[0]] - parts.xy[order[1]]).max(axis=(1, 2))
    assert np.median(apart) < 0.05  # pictures begin elsewhere


# --- real images --------------------------------------------------------------------------------------------


def frames(shared_data: Path) -> tuple[str, list[str]]:
    """A satellite's image of 2003, and four of an aerial camera of 2015."""
    aerial = sorted((shared_data / "cross_sensor/ngi_2015").glob("ngi*.tif"))
    return str(shared_data / "optical/qb2_single/qb2_basic1b.tif"), [str(path) for path in aerial]


def heights(shared_data: Path, lonlat: Array) -> Array:
    """Of the terrain [m above the ellipsoid] at places (n, 2) [deg]."""
    with rasterio.open(shared_data / "cross_sensor/ngi_2015/dem.tif") as dem:
        x, y = transform("EPSG:4326", dem.crs, *lonlat.T)
        row, col = (np.clip(n, 0, size - 1) for n, size in zip(rowcol(dem.transform, x, y), dem.shape, strict=True))
        return dem.read(1)[row, col].astype(float) + GEOID


@pytest.mark.costs(3)
@pytest.mark.slow
@pytest.mark.parametrize("number", rest_slow(range(4), mark=pytest.mark.nightly))
def test_a_satellite_and_an_aerial_camera_are_tied_over_twelve_years(shared_data, number) -> None:
    """Without a DEM. The frames' cameras are exact; the satellite's is 3.0, 2.1 px off, as surveyed points say."""
    satellite, aerial = frames(shared_data)
    both = load_views([satellite, aerial[number]]).views
    tracks = find_tracks(both).tracks
    assert [view.name[:3] for view in both] == ["ngi", "qb2"]
    assert tracks.num_points >= 12
    xy, other = common_tracks(tracks, 0, 1)
    ground = both[0].sensor.localize(xy, np.full(len(xy), 300.0))
    for _ in range(8):
        ground = both[0].sensor.localize(xy, heights(shared_data, ground[:, :2]))
    off = other - both[1].sensor.project(ground)
    np.testing.assert_allclose(np.median(off, axis=0), [-3.0, -2.1], atol=0.35)
    assert (np.hypot(*(off - np.median(off, axis=0)).T) > 3.0).mean() <= 0.05


MEASURED = """
import sys, time
from pathlib import Path
from barpc.cli import main
try:
    sys.exit(main(sys.argv[1:]))
finally:  # its own peak: what the kernel tells a parent counts the parent's, from before the child was another program
    print(time.process_time(), Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])
"""


@pytest.mark.nightly
def test_a_refusal_ends_within_seconds_a_megapixel_and_six_hundred_megabytes(shared_data, tmp_path) -> None:
    """The satellite's image upside down under the same RPC: nothing is where it should be."""
    satellite, aerial = frames(shared_data)
    with rasterio.open(satellite) as image:
        pixels, rpc = image.read(1), image.rpcs
    path = write_image(tmp_path / "turned.tif", np.ascontiguousarray(pixels[::-1, ::-1]), rpcs=rpc)
    words = ["match", str(path), aerial[0], "-o", str(tmp_path / "run")]
    run = subprocess.run([sys.executable, "-c", MEASURED, *words], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert re.search(r"too few tie points: .* no common offset within 1\d\d", run.stderr)
    seconds, kilobytes = map(float, run.stdout.splitlines()[-1].split())
    assert seconds <= 5.0 * (pixels.size / 1e6 + 0.74)  # idle
    assert kilobytes <= 600 * 1024
