"""Blocks of views with tie points and their truth, without pixels: what an adjustment is tried on.

The delivered camera of a view is an RPC P fitted to a pushbroom model; the exact camera is P behind a known
correction, P(R (X - T - C) + C). So the corrections that an adjustment looks for exist to the last digit, for
ten views or ten thousand. One RPC is fitted for every row of sites and every look; within a row the cameras
are turned about the Earth's axis, under which an RPC only changes the offset of its longitude.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.errors import InputError
from barpc.fit import fit_rpc
from barpc.geodesy import Array, wrap_longitude
from barpc.scene import BoolArray, GroundPoints, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Correction, rotation_matrix
from barpc.sensor.geometry import triangulate
from barpc.sensor.rpc import RPC
from barpc.simulate.orbit import fly, looks
from barpc.simulate.sites import BlockOptions, Grid, Seen


@dataclass(frozen=True, eq=False)
class BlockTruth:
    """What a block was made from.

    Parameters
    ----------
    corrections : tuple of Correction
        The exact correction of every view: `Corrected(view.sensor, correction)` is the exact camera.
    drift : (V, 3)
        Change of the rotation vector over the height of the image [rad]; it is zero in the middle row.
    ground : (P, 3)
        The tracks' ground points; lon, lat [deg], alt [m].
    outlier : (K,)
        Which observations are wrong.
    check_ground : (Q, 3)
        Held-out ground points; lon, lat [deg], alt [m].
    check : Tracks
        Their exact image points in every view that sees them.
    """

    corrections: tuple[Correction, ...]
    drift: Array
    ground: Array
    outlier: BoolArray
    check_ground: Array
    check: Tracks


@dataclass(frozen=True, eq=False)
class Block:
    """Views, tie points and GCPs as an adjustment receives them, with the truth.

    Parameters
    ----------
    views : tuple of View
        Without pixels; `sensor` is the delivered RPC.
    tracks : Tracks
        Observations with noise and outliers.
    gcps : GroundPoints
        Exact ground points with noisy observations; empty unless asked for.
    truth : BlockTruth
        What is to be found.
    """

    views: tuple[View, ...]
    tracks: Tracks
    gcps: GroundPoints
    truth: BlockTruth

    def held_out_rms(self, sensors: list[SensorModel]) -> float:
        """Root mean square residual [px, per coordinate] of the held-out points in other cameras.

        The points are triangulated anew from their exact image points: what no image can tell (a shift of
        the whole scene) does not count.

        Parameters
        ----------
        sensors : list of SensorModel
            One a view: delivered, adjusted or refitted cameras.
        """
        check = self.truth.check
        found = triangulate(sensors, check.view, check.point, check.xy)
        return float(np.sqrt(np.mean(found.residuals**2)))


def recentred(correction: Correction, center: Array) -> Correction:
    """The same correction about another camera centre (3,) [m, ECEF]: R stays, T takes up the difference."""
    turn = rotation_matrix(correction.rotation)
    shift = center - correction.center
    return Correction(correction.rotation, correction.translation + turn.T @ shift - shift, center)


def simulate_block(
    num_views: int = 3,
    num_tracks: int = 2000,
    *,
    seed: int = 0,
    lon: float = 5.4,
    lat: float = 43.3,
    num_checks: int = 500,
    num_gcps: int = 0,
    **options: object,
) -> Block:
    """A block of views with tie points, GCPs and held-out points.

    Views stand in groups of `per_site` over sites on a square grid; neighbouring sites overlap.

    Parameters
    ----------
    num_views, num_tracks, num_checks, num_gcps : int
        How many; a track or check point is seen by two views or more, a GCP by one or more.
    seed : int
        The same seed gives the same block.
    lon, lat : float
        Centre of the block [deg].
    **options
        Fields of `BlockOptions`.

    Returns
    -------
    block : Block

    Raises
    ------
    InputError
        Options that contradict each other, or a layout whose views do not overlap.
    """
    if num_views < 1 or num_tracks < 0 or num_checks < 0 or num_gcps < 0:
        raise InputError("block: at least one view, and no negative count")
    chosen = BlockOptions(**options)  # type: ignore[arg-type]
    rng = np.random.default_rng(seed)
    grid = Grid.square(num_views, chosen, lon, lat)
    views, centers = _cameras(grid, num_views, chosen)
    corrections = tuple(
        Correction(rng.normal(0, chosen.attitude, 3), rng.normal(0, chosen.position, 3), center)
        for center in centers
    )
    drift = rng.normal(0, chosen.drift, (num_views, 3)) if chosen.drift else np.zeros((num_views, 3))
    scene = Seen(views, corrections, drift, grid, chosen, rng)

    ground, tracks = scene.observe(num_tracks, fewest=2, visible=chosen.visible)
    noisy, outlier = _disturbed(tracks, chosen, rng)
    check_ground, check = scene.observe(num_checks, fewest=2, visible=1.0)
    gcp_ground, seen = scene.observe(num_gcps, fewest=1, visible=chosen.visible)
    gcp_seen, _ = _disturbed(seen, replace(chosen, outliers=0.0), rng)
    gcps = GroundPoints(
        names=tuple(f"gcp_{i:03d}" for i in range(len(gcp_ground))),
        lonlatalt=gcp_ground,
        sigma=np.full((len(gcp_ground), 3), 0.1),
        point=gcp_seen.point,
        view=gcp_seen.view,
        xy=gcp_seen.xy,
        xy_sigma=gcp_seen.sigma,
    )
    truth = BlockTruth(corrections, drift, ground, outlier, check_ground, check)
    return Block(views, noisy, gcps, truth)


def _cameras(grid: Grid, num_views: int, options: BlockOptions) -> tuple[tuple[View, ...], list[Array]]:
    """Views with delivered RPCs, and their camera centres (3,) [m, ECEF]; site by site."""
    views: list[View] = []
    centers: list[Array] = []
    low, high = options.alt_range
    margin = 0.1 * (high - low) + 50.0
    alt_range = (low - margin, high + margin)
    for row in range(grid.rows):
        lon0, lat = grid.lonlat(row, 0)
        target = np.array([lon0, lat, 0.5 * (low + high)])
        flown = [fly(target, look, options.size, options.gsd) for look in looks(options.per_site, 0.17 * row)]
        fitted = [fit_rpc(model, options.size, alt_range).rpc for model in flown]
        places = [model.position(0.5 * (options.size[1] - 1)) for model in flown]
        for column in range(grid.columns):
            for rpc, place in zip(fitted, places, strict=True):
                if len(views) == num_views:
                    return tuple(views), centers
                turn = column * grid.step[0]
                name = f"view_{len(views):04d}"
                views.append(View(name, "", options.size, _turned(rpc, turn), alt_range))
                centers.append(rotation_matrix(np.array([0.0, 0.0, np.radians(turn)])) @ place)
    return tuple(views), centers


def _turned(rpc: RPC, degrees: float) -> RPC:
    """The RPC of the same camera turned about the Earth's axis."""
    offset = rpc.ground_offset + np.array([degrees, 0.0, 0.0])
    offset[0] = wrap_longitude(offset[0])
    return replace(rpc, ground_offset=offset)


def _disturbed(tracks: Tracks, options: BlockOptions, rng: np.random.Generator) -> tuple[Tracks, BoolArray]:
    """The observations with noise and outliers, and which are outliers (K,)."""
    count = len(tracks)
    xy = tracks.xy + (rng.normal(0, options.noise, (count, 2)) if options.noise else 0.0)
    outlier = np.zeros(count, dtype=bool)
    outlier[rng.permutation(count)[: round(options.outliers * count)]] = True
    xy[outlier] += rng.uniform(-options.outlier_size, options.outlier_size, (int(outlier.sum()), 2))
    return Tracks(tracks.view, tracks.point, xy, np.full(count, options.noise or 0.1)), outlier
