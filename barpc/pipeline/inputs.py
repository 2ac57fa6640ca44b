"""What a run is given besides images: control points, terrain, tie points, an earlier block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barpc.ba import BlockPrior
from barpc.dem import Dem
from barpc.errors import InputError
from barpc.pipeline.options import RunOptions
from barpc.pointio.gcp import read_gcps
from barpc.scene import BoolArray, GroundPoints, Tracks, View
from barpc.sensor.geometry import footprint

PRIOR = "block.npz"
"""The file in a run folder that a later run starts from."""


def load_gcps(paths: Sequence[str], names: Sequence[str]) -> GroundPoints | None:
    """Control points of several files, one after the other; None without files."""
    parts = [read_gcps(path, names) for path in paths]
    if not parts:
        return None
    starts = np.cumsum([0, *(len(part.names) for part in parts)])[:-1]
    return GroundPoints(
        names=tuple(name for part in parts for name in part.names),
        lonlatalt=np.concatenate([part.lonlatalt for part in parts]),
        sigma=np.concatenate([part.sigma for part in parts]),
        point=np.concatenate([part.point + start for part, start in zip(parts, starts, strict=True)]),
        view=np.concatenate([part.view for part in parts]),
        xy=np.concatenate([part.xy for part in parts]),
        xy_sigma=np.concatenate([part.xy_sigma for part in parts]),
    )


@dataclass(frozen=True, eq=False)
class Given:
    """Side inputs, read before any work starts.

    Parameters
    ----------
    dem : Dem or None
        The terrain, with its geoid.
    prior : BlockPrior or None
        What an earlier run knows about its views.
    """

    dem: Dem | None
    prior: BlockPrior | None

    @classmethod
    def read(cls, options: RunOptions, views: Sequence[View]) -> Given:
        """Read them all; a file that cannot be used stops the run here, and not after an hour.

        Raises
        ------
        InputError
            A file is missing or does not parse, or a DEM holds no height under any of the views.
        """
        names = [view.name for view in views]
        load_gcps(options.gcp, names)
        load_gcps(options.check_points, names)
        dem = None if options.dem is None else Dem.open(options.dem, options.geoid)
        if dem is not None:
            _require_cover(dem, str(options.dem), views)
        prior = None if options.fixed_run is None else BlockPrior.load(Path(options.fixed_run) / PRIOR)
        return cls(dem, prior)


def _require_cover(dem: Dem, path: str, views: Sequence[View]) -> None:
    """Raise unless the terrain is known somewhere along the outlines of the views."""
    rings = [footprint(view.sensor, view.size, sum(view.alt_range) / 2) for view in views]
    lon, lat = np.concatenate(rings).T
    if np.isnan(dem(lon, lat)).all():
        raise InputError(
            f"{path}: holds no height at the images' place ({lon[0]:.4f}, {lat[0]:.4f}); is it another tile?"
        )


def input_files(options: RunOptions) -> list[Path]:
    """Every file that the options name; none of them is ever written."""
    named = [*options.gcp, *options.check_points, options.dem, options.geoid, options.matches]
    return [Path(path) for path in named if path is not None]


def only_new(tracks: Tracks, old: BoolArray) -> Tracks:
    """Tracks that tell something an earlier block did not know.

    Tracks without a new view are left out. Of those seen in several old views one old observation is kept: how
    these views lie to each other is in the earlier block's normal matrix already.

    Parameters
    ----------
    tracks : Tracks
        Tie points of old and new views.
    old : (N,)
        Views of the earlier block.
    """
    is_old = old[tracks.view]
    has_new = np.bincount(tracks.point, ~is_old, minlength=tracks.num_points) > 0
    order = np.lexsort((tracks.sigma, tracks.point))  # the surest old observation of a track comes first
    order = order[is_old[order]]
    _, first = np.unique(tracks.point[order], return_index=True)
    keep = ~is_old
    keep[order[first]] = True
    return tracks.select(keep & has_new[tracks.point])
