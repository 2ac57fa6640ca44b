"""The keywords of the verbs, for type checkers. Written by docs/generate_options.py: edit the records of options."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

from barpc.base.options import AdjustOptions, FitOptions, TieOptions

PathLike = str | os.PathLike[str]
Files = PathLike | Sequence[PathLike]


class RunKeywords(TypedDict, total=False):
    """Keywords of every run."""

    band: int
    matcher: str
    tile: int
    min_overlap: float
    angles: Sequence[float]
    neighbours: int
    search: float | None
    ratio: float
    min_matches: int
    points_per_image: int
    model: Literal["auto", "rotation+translation", "rotation", "translation", "shift", "shift-drift", "affine"]
    center: Literal["line", "projective"]
    drift: int | None
    jitter: str
    detectors: Sequence[float]
    terms: Literal["auto", "none"]
    sigma_attitude: float | None
    sigma_position: float | None
    noise_floor: float
    fixed: Sequence[str]
    dem_sigma: float
    dem_bias_sigma: float | None
    min_convergence: float
    solver: Literal["auto", "sparse"]
    method: Literal["auto", "ridge", "gauss-newton", "lcurve-joint"]
    grid: Sequence[int]
    space: Literal["image", "ground"]
    tolerance: float
    pole_margin: float
    tie: TieOptions | Mapping[str, Any]
    adjust: AdjustOptions | Mapping[str, Any]
    fit: FitOptions | Mapping[str, Any]
    images: Literal["vrt", "copy", "none"]
    rpc_formats: Sequence[str]
    grids: bool
    stop_after: Literal["matching", "adjustment", "all"]
    keep_going: bool
    overwrite: bool
    allow_remote: Sequence[str]
    matches: Files
    matches_only: bool
    overlap_list: PathLike | None
    aoi: PathLike | None
    gcp: Files
    gcp_crs: str | None
    altimetry: Files
    check_points: Files
    add_to: PathLike | None
    update: bool
    calibration: Files
    dem: Files
    geoid: PathLike | None
    heights: PathLike | None
    reference: Files
    reference_sigma: float | None
    rpc_format: Sequence[str]


class InfoKeywords(TypedDict, total=False):
    """Keywords of `InfoOptions`."""

    alt: float | None
    dem: Files
    geoid: PathLike | None
    at: Sequence[float] | None


class OrthoKeywords(TypedDict, total=False):
    """Keywords of `OrthoOptions`."""

    alt: float | None
    dem: Files
    geoid: PathLike | None
    gsd: float | None
    crs: str | None
    overwrite: bool


class ConvertKeywords(TypedDict, total=False):
    """Keywords of `ConvertOptions`."""

    alt: float | None
    dem: Files
    geoid: PathLike | None
    rpc: PathLike | None
    images: Literal["vrt", "copy"] | None
    rpc_format: str | None
    move: Sequence[float] | None
    transform: PathLike | None
    window: Sequence[int] | None
    bbox: Sequence[float] | None
    aoi: PathLike | None
    overwrite: bool


class RefitKeywords(TypedDict, total=False):
    """Keywords of `RefitOptions`."""

    method: Literal["auto", "ridge", "gauss-newton", "lcurve-joint"]
    grid: Sequence[int]
    space: Literal["image", "ground"]
    tolerance: float
    pole_margin: float
    alt_range: Sequence[float] | None
    dem: Files
    dem_margin: float
    geoid: PathLike | None
    keep_going: bool
    overwrite: bool


class DsmKeywords(TypedDict, total=False):
    """Keywords of `DsmOptions`."""

    gsd: float | None
    crs: str | None
    alt: Sequence[float] | None
    pairs: int
    band: int
    minus: PathLike | None
    overwrite: bool


class ExportKeywords(TypedDict, total=False):
    """Keywords of `ExportOptions`."""

    alt: Sequence[float] | None
    time: Sequence[str]
    date: Sequence[str]
    images: bool
    tolerance: float | None
    exact: bool
    overwrite: bool


class VerifyKeywords(TypedDict, total=False):
    """Keywords of `VerifyOptions`."""

    expect: str | None
    figures: bool


class CalibrateKeywords(TypedDict, total=False):
    """Keywords of `CalibrateOptions`."""

    sensor: str | None
    overwrite: bool
