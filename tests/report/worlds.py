"""Runs of small simulated worlds, of every kind that the report has sentences for: a row of `WORLDS` each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from barpc.ba import AdjustOptions, adjust_tracks, block_prior
from barpc.base.geodesy import DEFAULT, Array, HeightDatum, metres_per_unit
from barpc.base.options import RunOptions
from barpc.fit import fit_rpc
from barpc.report import Run
from barpc.report.outcome import Added
from barpc.scene import Altimetry, GroundPoints, IntArray, Reference, Tracks
from barpc.sensor.corrected import Corrected
from barpc.simulate import SimulatedBlock, simulate_block
from barpc.tie.reference import ReferenceControl, ViewMatch

SIZE = (4000, 4000)


def relief(lonlat: np.ndarray) -> np.ndarray:
    """Hills [m] of a kilometre or two."""
    east, north = (lonlat * metres_per_unit(np.array([5.0, 43.0, 0.0]))[:2]).T
    return (
        200.0 + 60.0 * np.sin(east / 300.0) + 45.0 * np.cos(north / 240.0) + 25.0 * np.sin((east + 2 * north) / 170.0)
    )


def exact_cameras(block: SimulatedBlock) -> list[Corrected]:
    return [Corrected(view.sensor, one) for view, one in zip(block.views, block.truth.corrections, strict=True)]


def seen_by(cameras: Sequence[Corrected], ground: Array, point: IntArray, view: IntArray) -> Array:
    """Where cameras see points: observations (n, 2)."""
    xy = np.empty((len(view), 2))
    for v, camera in enumerate(cameras):
        xy[view == v] = camera.project(ground[point[view == v]])
    return xy


def on_terrain(block: SimulatedBlock, heights: Array, rng: np.random.Generator) -> SimulatedBlock:
    """The block with its points at these altitudes, seen to 0.1 px."""
    ground, tracks = block.truth.ground.copy(), block.tracks
    ground[:, 2] = heights
    xy = seen_by(exact_cameras(block), ground, tracks.point, tracks.view)
    xy += rng.normal(0.0, 0.1, xy.shape)
    return replace(block, tracks=replace(tracks, xy=xy), truth=replace(block.truth, ground=ground))


def world(num: int = 3, points: int = 300, *, on_relief: bool = False, seed: int = 5, **options: Any) -> SimulatedBlock:
    """A block; with `on_relief` its points lie on the hills."""
    block = simulate_block(num, points, seed=seed, lon=5.0, lat=43.0, **{"size": SIZE, "attitude": 3e-6, **options})
    if not on_relief:
        return block
    return on_terrain(block, relief(block.truth.ground[:, :2]), np.random.default_rng(seed))


def run_of(block: SimulatedBlock, *, refit: bool = True, run: dict[str, Any] | None = None, **given: Any) -> Run:
    """The run of a block; `given`: of `adjust_tracks`; `run`: of `Run`."""
    run = {"options": RunOptions(), **(run or {})}
    options = given.pop("options", None) or AdjustOptions()
    adjustment = adjust_tracks(block.views, block.tracks, options, **given)
    if refit:
        cameras = zip(adjustment.sensors, block.views, strict=True)
        run.setdefault("fits", tuple(fit_rpc(s, v.size, v.alt_range, strict=False) for s, v in cameras))
        run.setdefault("written", tuple({f"{view.name}.vrt": {"gdal": 1e-9}} for view in block.views))
    return Run("adjust", block.views, (), block.tracks, adjustment=adjustment, gcps=given.get("gcps"), **run)


def moved(points: GroundPoints, rows: Any, shift: tuple[float, float, float]) -> GroundPoints:
    """Points of which some are given `shift` [m] east, north, up beside their place."""
    places = points.lonlatalt.copy()
    places[rows] += np.array(shift) / metres_per_unit(places[0])
    return replace(points, lonlatalt=places)


def with_gcps(change: Callable[[GroundPoints], GroundPoints] = lambda one: one, num: int = 6, **options: Any) -> Run:
    block = world(num_gcps=num, **options)
    return run_of(block, gcps=change(block.gcps), run={"options": RunOptions(gcp=("points.gcp",))})


def only(points: GroundPoints, keep: np.ndarray) -> GroundPoints:
    """Points of which some observations are left."""
    rows = {name: getattr(points, name)[keep] for name in ("view", "point", "xy")}
    sigma = points.xy_sigma if np.ndim(points.xy_sigma) == 0 else points.xy_sigma[keep]
    return replace(points, **rows, xy_sigma=sigma)


def with_dem(height: Callable[[np.ndarray], np.ndarray], **fields: Any) -> Run:
    block = world(on_relief=True)
    return run_of(
        block,
        dem=lambda lon, lat: height(np.column_stack([lon, lat])),
        run={"options": RunOptions(dem="dem.tif"), **fields},
    )


def displaced(rows: Callable[[Tracks], np.ndarray], by: tuple[float, float], **options: Any) -> Run:
    """A block whose observations are displaced in some rows or columns of an image."""
    block = world(points=900, **options)
    xy = block.tracks.xy.copy()
    xy[rows(block.tracks)] += by
    return run_of(replace(block, tracks=replace(block.tracks, xy=xy)))


def of_detectors() -> Run:
    """A block of which one image has four detectors, each displaced by itself."""
    block, sizes = world(points=1500), np.array([[0.0, 0.0], [0.9, -0.6], [-0.5, 0.8], [0.6, 0.5]])
    xy = block.tracks.xy.copy()
    own = block.tracks.view == 1
    xy[own] += sizes[np.searchsorted(SIZE[0] * np.array([0.25, 0.5, 0.75]), xy[own, 0])]
    return run_of(replace(block, tracks=replace(block.tracks, xy=xy)))


def swinging() -> Run:
    block = world(points=1500)
    xy = block.tracks.xy.copy()
    own = block.tracks.view == 1
    xy[own, 1] += 0.8 * np.sin(2 * np.pi * xy[own, 1] / 500.0)
    return run_of(replace(block, tracks=replace(block.tracks, xy=xy)))


def drifting(drift: int | None = None) -> Run:
    block = world(points=900, drift=8e-6)
    return run_of(
        block, options=AdjustOptions(drift=drift), run={"options": RunOptions(adjust=AdjustOptions(drift=drift))}
    )


def one_image(num: int, **fields: Any) -> Run:
    block = world(3, num_gcps=num)
    view = replace(block, views=block.views[:1], tracks=Tracks(*np.zeros((2, 0), int), np.zeros((0, 2)), np.zeros(0)))
    points = only(block.gcps, block.gcps.view == 0)
    return run_of(view, gcps=points, run={"options": RunOptions(gcp=("points.gcp",)), **fields})


def untied() -> Run:
    block = world(4, 400, per_site=4)
    keep = block.tracks.view != 3
    return run_of(replace(block, tracks=block.tracks.select(keep)), keep_largest=True)


def foreign(num: int = 4, **options: Any) -> Run:
    """An image with the RPC of another place, 40 px off in turn and scale."""
    block = world(num, 100 * num, per_site=min(num, 4), **options)
    xy = block.tracks.xy.copy()
    own = block.tracks.view == 1
    xy[own] += 0.02 * (xy[own] - 2000.0)[:, ::-1] * (1, -1)
    return run_of(replace(block, tracks=replace(block.tracks, xy=xy)))


def floating() -> Run:
    """A quarter of the tie points on a cloud that moves between the images."""
    block = world(points=900)
    tracks, xy = block.tracks, block.tracks.xy.copy()
    cloud = np.flatnonzero(block.truth.ground[:, 0] > np.quantile(block.truth.ground[:, 0], 0.75))
    rows = np.isin(tracks.point, cloud)
    xy[rows] += np.outer(tracks.view[rows], (6.0, 3.0))
    return run_of(replace(block, tracks=replace(tracks, xy=xy)))


def on_reference(matched: bool) -> Run:
    """A block whose points of a reference are the GCPs of a block, or that it does not show."""
    block = world(num_gcps=20)
    found = [
        ViewMatch(v.name, 9.0 if matched else 3.0, (3.0, -4.0), 50, 20, 18 * matched, gsd=0.5) for v in block.views
    ]
    points = replace(block.gcps, sigma=np.full((20, 3), 2.0))
    control = Reference(points, np.array([1.0, 1.0, 5.0]), np.full((3, 2), 3.0)) if matched else None
    held = ReferenceControl(control, tuple(found), 2.0, 1.0)
    return run_of(
        block, reference=control, run={"reference": held, "options": RunOptions(reference=("o.tif",), dem="d.tif")}
    )


def with_altimetry(off: float, wrong: float = 0.0) -> Run:
    block, rng = world(points=900, on_relief=True), np.random.default_rng(2)
    ground = block.truth.ground
    low, high = ground[:, :2].min(axis=0), ground[:, :2].max(axis=0)
    lonlat = rng.uniform(low, high, (200, 2))
    alt = (
        relief(lonlat) + off + rng.normal(0, 0.3, 200) + np.where(rng.random(200) < wrong, rng.uniform(5, 90, 200), 0.0)
    )
    heights = Altimetry(np.column_stack([lonlat, alt]), np.full(200, 0.3), np.zeros(200))
    return run_of(block, altimetry=heights, run={"options": RunOptions(altimetry=("a.csv",))})


def grown() -> Run:
    """An image more of a finished block."""
    block = world(4, 600, per_site=4)
    old = block.tracks.select(block.tracks.view < 3)
    old = old.select(np.bincount(old.point, minlength=old.num_points)[old.point] > 1)
    prior = block_prior(adjust_tracks(block.views[:3], old))
    change = Added("before", 3, 3, (), (block.views[0].name, 0.012), 0.05, False)
    found = run_of(block, prior=prior, known=np.ones(len(block.tracks), bool), run={"added": change})
    return replace(found, options=RunOptions(add_to="before"))


def checked(**options: Any) -> Run:
    block = world(**options)
    return Run("check", block.views, (), block.tracks, options=RunOptions())


def after(run: Run, **fields: Any) -> Run:
    """A run with other fields."""
    return replace(run, **fields)


def tested() -> Run:
    block = world(num_gcps=6)
    return run_of(block, run={"check_points": block.gcps, "options": RunOptions(check_points=("c.gcp",))})


def copied() -> Run:
    """Two images that are one picture, moved."""
    block = world()
    tracks = block.tracks
    first = {int(p): tracks.xy[k] for k, p in enumerate(tracks.point) if tracks.view[k] == 0}
    xy, keep = tracks.xy.copy(), np.ones(len(tracks), dtype=bool)
    for k in np.flatnonzero(tracks.view == 1):
        keep[k] = int(tracks.point[k]) in first
        xy[k] = first.get(int(tracks.point[k]), xy[k]) + (7.0, -3.0)
    views = (block.views[0], replace(block.views[0], name=block.views[1].name), block.views[2])
    return run_of(replace(block, views=views, tracks=replace(tracks, xy=xy).select(keep)))


DATUM = HeightDatum("gcps", "6 GCPs", 48.0, DEFAULT)
WORLDS: dict[str, Callable[[], Run]] = {
    "three images": lambda: run_of(world()),
    "a wrong GCP": lambda: with_gcps(lambda one: moved(one, [2], (20.0, -15.0, 5.0))),
    "forty with a bad one": lambda: foreign(40, overlap=0.4),
    "two images": lambda: run_of(world(2, 200, per_site=2)),
    "one image on GCPs": lambda: one_image(6),
    "one image on two GCPs": lambda: one_image(2),
    "GCPs": with_gcps,
    "one GCP": lambda: with_gcps(num=1),
    "GCPs in one image": lambda: with_gcps(lambda one: only(one, one.view == 0)),
    "all GCPs too high": lambda: with_gcps(lambda one: moved(one, slice(None), (0.0, 0.0, 48.0))),
    "unstated heights of GCPs": lambda: after(with_gcps(), datums=(DATUM,)),
    "two sets of GCPs": lambda: with_gcps(lambda one: moved(one, [0, 1, 2], (25.0, 0.0, 0.0))),
    "scattered GCPs": lambda: with_gcps(
        lambda one: moved(one, slice(None), np.random.default_rng(1).normal(0, 15, (one.lonlatalt.shape)))
    ),  # type: ignore[arg-type]
    "a point left out": lambda: after(with_gcps(lambda one: replace(one, left_out=("p7 is outside of all images",)))),
    "a DEM": lambda: with_dem(relief),
    "a DEM 60 m too low": lambda: with_dem(lambda at: relief(at) - 60.0),
    "a DEM of another place": lambda: with_dem(lambda at: relief(at[:, ::-1] + (40.0, -33.0))),
    "a DEM elsewhere": lambda: with_dem(lambda at: np.full(len(at), np.nan)),
    "a reference": lambda: on_reference(True),
    "a reference not found": lambda: on_reference(False),
    "altimetry": lambda: with_altimetry(0.0),
    "altimetry that disagrees": lambda: with_altimetry(0.0, 0.9),
    "drift": drifting,
    "drift asked for": lambda: drifting(2),
    "jitter": swinging,
    "displaced rows": lambda: displaced(lambda t: (t.view == 1) & (t.xy[:, 1] > 2800), (0.0, 1.5)),
    "displaced columns": lambda: displaced(lambda t: (t.view == 1) & (t.xy[:, 0] > 2800), (0.0, 1.5)),
    "displaced detectors": of_detectors,
    "wrong matches": lambda: run_of(world(points=600, outliers=0.35)),
    "a foreign camera": foreign,
    "moving objects": floating,
    "cameras worse than stated": lambda: run_of(world(attitude=2e-4)),
    "an image without ties": untied,
    "few tie points": lambda: run_of(world(points=22)),
    "a copy": copied,
    "an image more": grown,
    "check points": tested,
    "files left out": lambda: after(run_of(world()), left_out=(("d.tif", "d.tif: no RPC"),)),
    "a check": checked,
    "a check of good cameras": lambda: checked(attitude=0.0, position=0.0),
    "a match": lambda: after(checked(), kind="match"),
    "no tie points": lambda: after(checked(), tracks=Tracks(*np.zeros((2, 0), int), np.zeros((0, 2)), np.zeros(0))),
}
"""Kind of a run -> how it is made."""
