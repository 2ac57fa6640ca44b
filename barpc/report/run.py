"""What a run knows at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from barpc.ba import Adjustment
from barpc.cameras import Camera
from barpc.fit import RpcFit
from barpc.geodesy import Array, ground_from_ecef
from barpc.report.measures import PairTies, pair_ties, triangulate_tracks, whole_shift
from barpc.scene import BoolArray, GroundPoints, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.geometry import CameraCenter, Triangulation
from barpc.tie import PairReport


@dataclass(frozen=True, eq=False)
class Run:
    """Everything that a run found out.

    Parameters
    ----------
    kind : {"adjust", "check", "match"}
        Whether cameras were adjusted, looked at, or only tied.
    views : tuple of View
        The images.
    sources : tuple of Camera
        Where their RPCs came from; empty for views that were not read from files.
    tracks : Tracks
        Tie points.
    matched : tuple of PairReport
        Pairs that were matched; empty for tie points from a file.
    adjustment : Adjustment or None
        None for a check.
    centers : tuple of CameraCenter
        Camera centres, for an adjustment.
    fits : tuple of RpcFit
        Refitted RPCs, for an adjustment that went so far.
    written : tuple of mapping
        Per view: output name to what each consumer that reopened it found: the largest difference to P_BA
        [px], or why it does not read the file.
    left_out : tuple of (str, str)
        Files that were left out, and why.
    options : object
        The options of the run, a dataclass.
    stages : sequence of mapping
        Seconds and peak memory of the stages so far.
    out_dir : str
        Where results are.
    gcps : GroundPoints or None
        Ground control of the adjustment.
    check_points : GroundPoints or None
        Ground points that stayed out of it.
    """

    kind: str
    views: tuple[View, ...]
    sources: tuple[Camera, ...]
    tracks: Tracks
    matched: tuple[PairReport, ...] = ()
    adjustment: Adjustment | None = None
    centers: tuple[CameraCenter, ...] = ()
    fits: tuple[RpcFit, ...] = ()
    written: tuple[Mapping[str, Mapping[str, float | str]], ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    options: object = None
    stages: Sequence[Mapping[str, Any]] = field(default_factory=list)
    out_dir: str = ""
    gcps: GroundPoints | None = None
    check_points: GroundPoints | None = None

    @property
    def before(self) -> tuple[SensorModel, ...]:
        """The cameras as delivered."""
        return tuple(view.sensor for view in self.views)

    @property
    def after(self) -> tuple[SensorModel, ...] | None:
        """The refitted cameras; P_BA where they were not refitted; None for a check."""
        if self.fits:
            return tuple(fit.rpc for fit in self.fits)
        return None if self.adjustment is None else self.adjustment.sensors

    @property
    def keep(self) -> BoolArray:
        """The observations (K,) that count: all of them, or those that the adjustment kept."""
        return np.ones(len(self.tracks), dtype=bool) if self.adjustment is None else self.adjustment.inlier

    @cached_property
    def pairs(self) -> list[PairTies]:
        """The observations that pairs of views have in common."""
        return pair_ties(self.tracks, self.keep)

    @cached_property
    def copies(self) -> dict[str, str]:
        """Views that show the very pixels of another one, and in words whose, and how far moved."""
        found: dict[str, str] = {}
        for ties in self.pairs:
            shift = whole_shift(ties, self.tracks)
            if shift is not None:
                names = [self.views[i].name for i in ties.views]
                for name, other, (col, row) in zip(names, names[::-1], (shift, 0.0 - shift), strict=True):
                    found.setdefault(name, f"{other}, moved by {col:.0f} columns and {row:.0f} rows")
        return found

    @property
    def start_altitude(self) -> float:
        """Where triangulation starts [m]: the middle of the views' altitude ranges."""
        return float(np.mean([view.alt_range for view in self.views]))

    @cached_property
    def ties_before(self) -> Triangulation:
        """The tie points through the delivered cameras."""
        return triangulate_tracks(self.tracks, self.before, self.start_altitude, self.keep)

    @cached_property
    def altitudes_before(self) -> Array:
        """Altitudes of the tie points (P,) through the delivered cameras [m]."""
        return ground_from_ecef(self.ties_before.points)[:, 2]

    @cached_property
    def ties_after(self) -> Triangulation | None:
        """The tie points through the new cameras; None for a check."""
        if self.after is None:
            return None
        return triangulate_tracks(self.tracks, self.after, self.start_altitude, self.keep)

    @cached_property
    def ground(self) -> Array:
        """The tie points (P, 3), lon, lat [deg], alt [m], through the best cameras there are."""
        return ground_from_ecef((self.ties_after or self.ties_before).points)

    @cached_property
    def altitude(self) -> float:
        """Altitude of the scene [m]: the median of its tie points; without any, where they would start."""
        alt = self.ground[np.isfinite(self.ground).all(axis=1), 2]
        return float(np.median(alt)) if len(alt) else self.start_altitude
