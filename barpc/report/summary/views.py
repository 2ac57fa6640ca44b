"""Records of the images of a run, and the cells of an image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from barpc.base.geodesy import Array
from barpc.report.records import Cell, Column, Number, Record, column, value_of
from barpc.report.summary.words import ABOVE, CAUSES, STATUS_WORDS, Count, Pixel, Share, Side, Vector, largest
from barpc.scene import IntArray

COVERAGE_CELLS = 8  # Cells of an image from left to right and from top to bottom


class EllipseEntry(Record):
    """Error ellipse of the ground point at the image centre, at a given altitude."""

    major_m: Number = column("Larger semi-axis of the one-sigma ellipse", "m", "major semi-axis", ".2f")
    minor_m: Number = column("Smaller semi-axis of the one-sigma ellipse", "m", "minor semi-axis", ".2f")
    azimuth_deg: Number = column("Direction of the larger semi-axis, clockwise from north", "deg", "azimuth", ".0f")
    ce90_m: Number = column(
        "Radius of the circle that contains 90 % of the errors, with the new camera", "m", "CE90", ".2f"
    )


class SourceEntry(Record):
    """Source of a camera."""

    format: str = column("Format of the file or tag that it was read from", head="RPC read from")
    path: str = column("File with the camera")
    notes: tuple[str, ...] = column("Remarks")


class CorrectionEntry(Record):
    """Correction of a camera: in space, or by a shift and slope in the image (no `center_shift_px` then)."""

    model: str = column("Unknowns of the adjustment")
    unknowns: tuple[float, ...] = column("In metres (rotation: angle x distance), or px in the image")
    sigma: tuple[float, ...] = column("Their posterior standard deviations, in the same units")
    center_shift_px: Pixel | None = column("Shift at the image centre", "px", "shift col, row", "+.2f", adjusted=True)
    center_sigma_px: Pixel | None = column(
        "Its posterior standard deviation, including that of the scene's position", "px"
    )
    shift_px: Pixel | None = column("Models in the image: shift col, row", "px", default=None)
    slope: tuple[Pixel, ...] | None = column("Models in the image: by (col, row)", "px/px", default=None)
    rotation_urad: Vector | None = column("Rotation vector R, ECEF axes", "urad", default=None)
    angle_urad: Number = column("Angle by which the camera was rotated (R)", "urad", "rotation", ".2f", default=None)
    translation_m: Vector | None = column("Translation T, ECEF", "m", default=None)
    translation_norm_m: Number = column(
        "Distance by which the camera was moved (T)", "m", "translation", ".2f", default=None
    )
    drift_urad: tuple[Vector, ...] | None = column("Drift, for each power of the row", "urad", default=None)
    jitter_px: Number = column("RMS of the spline over the rows", "px", "jitter", ".2f", default=None)
    jitter_rows: Number = column("Rows between its knots", "px", default=None)
    detector_px: Number = column("RMS of the steps between detectors", "px", "detectors", ".2f", default=None)
    step_px: Number = column("RMS of the displaced rows or columns (steps)", "px", "steps", ".2f", default=None)
    sinusoid_px: Number = column("Amplitude of the sinusoids along the rows", "px", "sinusoids", ".2f", default=None)
    sinusoid_rows: tuple[float, ...] | None = column("Their periods", "px", default=None)
    ellipse: EllipseEntry | None = column(
        "Error ellipse of the image centre, including the scene's position", default=None
    )
    detectors: tuple[float, ...] | None = column("Columns at which another detector begins", "px", default=None)


class CenterEntry(Record):
    """Projection centre of a camera."""

    ecef_m: Vector = column("Position, ECEF", "m")
    altitude_m: Number = column("Altitude of the projection centre above the ellipsoid", "m", "camera altitude", ",.0f")
    method: str = column("line: intersection of the rays of an image line; nominal: assumed where implausible")


class FitEntry(Record):
    """The certificate of a refitted RPC: its error against P_BA on independent check points."""

    rmse_px: Pixel = column("Error col, row on check points", "px", "RMSE col, row", ".1e")
    max_px: Pixel = column("Largest error col, row on check points", "px")
    min_denominator: Number = column(
        "Smallest denominator over the image's ground, relative to the centre", "", "smallest denominator", ".3f"
    )
    roundtrip_px: Number = column(
        "Largest change of a pixel by localisation and projection; none where that fails", "px", "round trip", ".1e"
    )
    coverage: Number = column("Share of the image covered by the fit's points", head="covered", form=".0%")
    method: str = column("Method of the fit", head="method")
    num_check_points: Count = column("Check points", head="points")


def _moves(view: ViewEntry) -> list[Cell]:
    shift, sigma = (value_of(view, f"correction.center_{what}_px") for what in ("shift", "sigma"))
    return [Cell(f"{value:+.3f} ± {error:.2f}", value) for value, error in zip(shift, sigma, strict=True)]


def _verdict(view: ViewEntry) -> Cell:
    return Cell(STATUS_WORDS[view.status], list(STATUS_WORDS).index(view.status), f"status {view.status}")


class ViewEntry(Record):
    """One image."""

    OWN: ClassVar = {
        "verdict": Column("verdict", _verdict),
        "wrong": Column("reservation", lambda view: CAUSES[view.cause].label if view.cause in CAUSES else None),
        "lost": Column(
            "rejected [%]",
            lambda view: 100.0 * view.lost if view.num_observations + view.num_rejected else None,
            ".1f",
            text="Observations rejected as outliers, of those used or rejected",
        ),
        "moves": Column(
            ("col [px]", "row [px]"), _moves, ".3f", text="Shift at the image centre ± its standard deviation"
        ),
        "largest": Column(
            "largest [px]",
            lambda view: largest(value_of(view, "fit.max_px")),
            ".1e",
            adjusted=True,
            text="Largest error on check points",
        ),
    }
    CAPTION: ClassVar = "Images: tie points, and the RMS of their residuals"
    PAGE: ClassVar = (
        "name verdict wrong num_observations num_check lost tie_coverage rmse_before rmse_after held_out_px "
        "correction.center_shift_px gsd_m incidence_deg rpc_source.format"
    )
    TERMINAL: ClassVar = "name verdict num_observations lost rmse_before rmse_after correction.center_shift_px"
    CORRECTIONS: ClassVar = "name moves correction.angle_urad correction.translation_norm_m camera_center.altitude_m"
    PLACES: ClassVar = (
        "name correction.ellipse.major_m correction.ellipse.minor_m correction.ellipse.azimuth_deg "
        "correction.ellipse.ce90_m stated_ce90_m"
    )
    DECISIONS: ClassVar = (
        "name prior_scale num_rejected num_moving systematic_px systematic_p "
        "neighbour_correlated_px correction.jitter_px correction.detector_px correction.step_px correction.sinusoid_px"
    )
    FOOTPRINT: ClassVar = "name path status num_observations rmse_before rmse_after gsd_m"
    CONTROL: ClassVar = "name control_w control_w_point"
    FITS: ClassVar = (
        "name fit.rmse_px largest fit.min_denominator fit.roundtrip_px fit.coverage fit.num_check_points fit.method"
    )

    @property
    def lost(self) -> float:
        """Share of its tie points that were rejected."""
        return self.num_rejected / max(self.num_rejected + self.num_observations, 1)

    @property
    def reservation(self) -> str:
        """Its verdict and advice as a sentence; without meaning for an image without reservation."""
        return f"{self.name}: {STATUS_WORDS[self.status]}. {self.advice}."

    name: str = column("Unique in the run", head="image", min_length=1)
    path: str = column("The image; empty for a view without pixels")
    size: tuple[Side, Side] = column("Width, height", "px")
    alt_range_m: tuple[float, float] = column("Altitude range of the camera", ABOVE)
    rpc_source: SourceEntry | None = column("Source of the camera; null: not from a file")
    gsd_m: Number = column("Ground sampling distance at the image centre", "m", "GSD", ".2f")
    incidence_deg: Number = column("Incidence angle, from the vertical to the sensor", "deg", "incidence", ".1f")
    azimuth_deg: Number = column("Direction to the sensor, clockwise from north", "deg")
    num_observations: Count = column("Observations of tie points in use", head="used")
    num_rejected: Count = column("Observations rejected as outliers", head="rejected")
    num_gcps: Count = column("Observations of ground control points")
    tie_coverage: Share = column("Share of the cells of an 8 x 8 grid with a tie point", head="covered", form=".0%")
    rmse_before: Number = column("RMS reprojection error through the delivered cameras", "px", "before", ".3f")
    rmse_after: Number = column(
        "RMS reprojection error through the new cameras; none where cameras were only checked",
        "px",
        "after",
        ".3f",
        adjusted=True,
    )
    systematic_px: Number = column("RMS of systematic residuals, noise subtracted", "px", "systematic", ".3f")
    prior_scale: Number = column(
        "Factor by which the camera's stated standard deviations were multiplied", "", "prior sigma factor", ".1f"
    )
    correction: CorrectionEntry | None = column("The correction; null for a check")
    camera_center: CenterEntry | None = column("Projection centre, about which the camera was rotated")
    fit: FitEntry | None = column("Certificate of the refitted RPC; null where none was fitted")
    outputs: Mapping[Annotated[str, Meta(pattern="^[^/]+$")], Mapping[str, float | str | None]] = column(
        "File -> consumer -> difference from the corrected camera in px, or the reason without one"
    )
    status: Literal["adjusted", "consistent", "tied", "weak", "doubtful", "failed"] = column("Verdict on the image")
    advice: str = column("Reservation and remedy; empty without reservation")
    cause: str | None = column("Name of the reservation; null without one", default=None, enum=CAUSES)
    num_moving: Count = column(
        "Observations excluded because tie points move together, as on clouds", head="excluded", default=0
    )
    num_check: Count = column("Observations of check tie points, kept out of the adjustment", head="check", default=0)
    held_out_px: Number = column("RMS of check tie points", "px", "after, check", ".3f", default=None)
    stated_ce90_m: Number = column(
        "CE90 that the delivered camera's file states; rotation and translation have it each as prior",
        "m",
        "CE90 stated",
        ".1f",
        default=None,
    )
    systematic_p: Number = column(
        "Probability of systematic residuals as large by noise alone (F test)", "", "F test p", ".1e", default=None
    )
    neighbour_correlated_px: Number = column(
        "Part of the residuals that neighbouring tie points share", "px", "correlated", ".3f", default=None
    )
    control_w: Number = column(
        "Largest Baarda's w of the control points in the image: a residual over its standard deviation",
        "",
        "largest w",
        ".1f",
        default=None,
    )
    control_w_point: str | None = column("Control point of that w", head="largest at", default=None)
    date: str | None = column("Acquisition date, where its metadata state it", default=None)
    certified: tuple[tuple[float, float, float, float, float], ...] | None = column(
        "Ground points (lon, lat, alt) and their image points (col, row)", default=None
    )
    gap: tuple[tuple[float, float, float, float], ...] | None = column(
        "Corners of rows or columns with few tie points (lon, lat, col, row)", default=None
    )


def cell_numbers(xy: Array, size: Sequence[int] | IntArray) -> IntArray:
    """Return the cell numbers (n,), of `COVERAGE_CELLS` x `COVERAGE_CELLS` cells, of points (n, 2) [px] in an image.

    `size`: width and height of the image, or (n, 2) of the image of each point [px].
    """
    col, row = ((xy + 0.5) / np.asarray(size) * COVERAGE_CELLS).astype(np.int64).clip(0, COVERAGE_CELLS - 1).T
    return np.asarray(row * COVERAGE_CELLS + col)
