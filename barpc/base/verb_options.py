"""The options of verbs beside those of a run: a record each, for its flags and for its keywords in Python."""

from __future__ import annotations

import re
from typing import Literal

from barpc.base.declarations import Options, option
from barpc.base.errors import InputError, UsageError
from barpc.base.options import GEOID_HELP

LONGEST_MOVE = 22e3  # m along an axis: from the sea's deepest bottom to the highest ground


class HeightOptions(Options):
    """Heights of the ground that images show."""

    alt: float | None = option(
        None,
        "Altitude where no DEM is given. Without: that of the run's tie points, else the middle of the camera's.",
        unit="m",
    )
    dem: tuple[str, ...] = option(
        (), "Take the altitudes from a DEM; of several, from the first that has one.", unit="file"
    )
    geoid: str | None = option(None, GEOID_HELP, unit="file", metavar="NAME|FILE")


class InfoOptions(HeightOptions):
    """Options of `barpc.info`."""

    at: tuple[float, float, float] | None = option(
        None, "Ground point of the angles. Without: the centre of the image.", metavar="LON LAT ALT"
    )


class OrthoOptions(HeightOptions):
    """Options of `barpc.ortho`."""

    gsd: float | None = option(None, "Side of a pixel. Without: that of the finest image.", unit="m", above=0)
    crs: str | None = option(None, "Map projection in metres. Without: the UTM zone of the first image.", unit="name")
    overwrite: bool = option(False, "Replace orthoimages of an earlier call.")


class ConvertOptions(HeightOptions):
    """Options of `barpc.convert`; some go with a folder alone (`out_dir`, -o)."""

    rpc: str | None = option(None, "With a folder: an RPC file, or a folder of them by image name.", unit="file")
    images: Literal["vrt", "copy"] | None = option(None, "With a folder: the image files. Without: vrt.")
    rpc_format: str | None = option(
        None, "Formats with commas between. Without: that of the target's name; in a folder txt.", metavar="NAMES"
    )
    move: tuple[float, float, float] | None = option(
        None,
        "With a folder: shift the ground east, north, up, from its position by the cameras to the true one.",
        unit="m",
        above=-LONGEST_MOVE,
        below=LONGEST_MOVE,
        metavar="E,N,U",
    )
    transform: str | None = option(
        None,
        "With a folder: the same by a 4 x 4 (or 3 x 4) matrix of ECEF coordinates, as pc_align writes it.",
        unit="file",
    )
    window: tuple[int, int, int, int] | None = option(
        None, "Cut out a part of one image.", unit="px", metavar="COL ROW WIDTH HEIGHT"
    )
    bbox: tuple[float, float, float, float] | None = option(
        None,
        "Cut out a box; with a folder of every image that covers it.",
        unit="deg",
        metavar="WEST SOUTH EAST NORTH",
    )
    aoi: str | None = option(None, "Cut out the box around polygons in lon/lat (GeoJSON), as with `bbox`.", unit="file")
    overwrite: bool = option(False, "Replace an existing file, or files of an earlier run.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.move is not None and self.transform is not None:
            raise UsageError("give either --move or --transform")

    @property
    def cut(self) -> bool:
        """Whether a part of each image is cut out."""
        return any(one is not None for one in (self.window, self.bbox, self.aoi))


class RefitOptions(Options):
    """Options of `barpc.fit` beside those of `FitOptions`."""

    alt_range: tuple[float, float] | None = option(
        None,
        """Altitudes above the ellipsoid to fit over. Without: the camera's own; of a radar all ground on Earth, -500
        to 9000 m, where an RPC holds it.""",
        unit="m",
        metavar="LOW HIGH",
    )
    dem: tuple[str, ...] = option((), "Take the altitudes of this DEM over the image, with a margin.", unit="file")
    dem_margin: float = option(500.0, "Margin below and above the DEM.", unit="m", least=0)
    geoid: str | None = option(None, GEOID_HELP, unit="file", metavar="NAME|FILE")
    keep_going: bool = option(False, "Write the RPC although it misses the tolerance.")
    overwrite: bool = option(False, "Replace an existing file.")


class DsmOptions(Options):
    """Options of `barpc.dsm.make_dsm`."""

    gsd: float | None = option(
        None,
        "Side of a cell. Without: twice the side of a pixel on the ground.",
        unit="m",
        above=0,
        most=1000,
    )
    crs: str | None = option(
        None,
        "Reference system of the map, in metres, such as `EPSG:32631`. Without: the UTM zone of the images.",
        unit="name",
    )
    alt: tuple[float, float] | None = option(
        None,
        """Range of altitudes to search for the ground. Without: that of a run's tie points and a margin, or that of the
        cameras.""",
        unit="m",
        least=-1000,
        most=10000,
        metavar="LOW HIGH",
    )
    pairs: int = option(4, "Most image pairs matched at a point; the best come first.", least=1, most=16)
    band: int = option(1, "Band of multi-band images, from 1.", least=1)
    minus: str | None = option(
        None,
        """Subtract the surface of the images of this run, and write the change: a finished run of the images of one
        date, which the run of both dates also has. Errors common to both dates cancel.""",
        unit="dir",
        metavar="OTHER_RUN",
    )
    overwrite: bool = option(False, "Replace the file if it exists.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.alt is not None and not self.alt[0] < self.alt[1]:
            raise InputError(f"alt: the lower altitude comes first, found {self.alt}")


class ExportOptions(Options):
    """Options of `barpc.export`."""

    alt: tuple[float, float] | None = option(
        None,
        "Altitudes of the scene, above the ellipsoid. Without: those of its tie points, and a margin.",
        unit="m",
        metavar="LOW HIGH",
    )
    time: tuple[str, ...] = option(
        (),
        "UTC time of images whose files state none (`satnerf` asks for it), or of one: 2013-04-17T10:36:44.",
        metavar="[IMAGE=]TIME",
    )
    date: tuple[str, ...] = option((), "Their day, where the time is not known (`stac`).", metavar="[IMAGE=]DAY")
    images: bool = option(
        False,
        "`colmap`: resample the images into pictures and masks. Without, `warp.sh` lets GDAL do it.",
    )
    tolerance: float | None = option(
        None,
        "`colmap`: largest error of a pinhole; images are cut into parts for it. Without: 0.1.",
        unit="px",
        above=0,
    )
    exact: bool = option(
        False,
        "`colmap`: the nearest pinholes of the images as they are, principal points far outside.",
    )
    overwrite: bool = option(False, "Replace what an earlier export wrote.")


class VerifyOptions(Options):
    """Options of `barpc.verify`."""

    expect: str | None = option(
        None, "The root that was printed, or a later one: 64 hexadecimal digits.", metavar="ROOT"
    )
    figures: bool = option(
        False, "Measure the RMS of every image again, by its files as GDAL or another tool reads them."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.expect is not None and not re.fullmatch("[0-9a-fA-F]{64}", self.expect):
            raise UsageError(f"--expect {self.expect}: a root has 64 hexadecimal digits")


class CalibrateOptions(Options):
    """Options of `barpc.calibrate`."""

    sensor: str | None = option(
        None, "Its name: images that state another one are excluded. Without: all state the same.", unit="name"
    )
    overwrite: bool = option(False, "Replace the file if it exists.")
