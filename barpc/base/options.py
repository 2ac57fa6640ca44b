"""The options of a run: four records, `PAPER`'s values of them, and options files."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any, Literal

from barpc.base.declarations import Options, Rule, checked, declared, option, with_values
from barpc.base.errors import InputError
from barpc.base.remote import HOST_PATTERN
from barpc.base.safe_io import BYTES_PER_NUMBER, OPTIONS, TABLE, read_text

AUTO, OFF, GEOMETRIC = "auto", "off", "rotation+translation"
Model = Literal["auto", "rotation+translation", "rotation", "translation", "shift", "shift-drift", "affine"]
GEOID_HELP = (
    "Geoid of the heights of a DEM or of ground points: `egm96`, `egm2008`, the file of a grid, or `none` for "
    "ellipsoidal heights. Without: the one that their file names."
)
HEIGHTS_HELP = (
    "Vertical datum of heights in files that state none: `ellipsoidal`, `egm96`, `egm2008`, a geoid's grid; `flat`: "
    "ellipsoidal, all points alike."
)
MOST_POINTS = (TABLE.most or 0) // (5 * BYTES_PER_NUMBER)
"""Control points of a fit: as many as a table of them may hold, five numbers each."""


class TieOptions(Options):
    """Options of tie-point search; every length is in pixels of the full image."""

    band: int = option(1, "Band of multi-band images, from 1.", least=1)
    matcher: str = option(
        "guided",
        """Matcher of a pair: `guided`, keypoints, and structure where they find few; `structure`, gradients independent
        of grey values, and `fine-structure`, at whole pixels, where that finds nothing. `module:name`: your own
        function in an importable module; it is run.""",
        rows="barpc.tie.matchers.matching.MATCHERS",
        hook=True,
    )
    tile: int = option(1024, "Side of the tiles for reading and keypoint detection.", unit="px", least=128)
    min_overlap: float = option(
        0.05, "Share of the smaller footprint that a pair of views must have in common.", least=0, most=1
    )
    angles: tuple[float, float] = option(
        (0.0, 60.0), "Smallest and largest convergence angle of a pair.", unit="deg", least=0, most=180
    )
    neighbours: int = option(8, "Best partners tried for a view, besides the pairs that connect all views.", least=1)
    search: float | None = option(
        None,
        "Largest expected camera error in any direction. Without: 700 m on the ground, 20 px at least, 700 at most.",
        unit="px",
        above=0,
    )
    ratio: float = option(
        0.85,
        "Largest descriptor distance of the best candidate over that of the second best.",
        above=0,
        most=1,
    )
    min_matches: int = option(
        12, "Verified matches that a pair needs; two thirds where thresholds are relaxed.", least=4
    )
    points_per_image: int = option(
        5000,
        "Most observations kept in an image, evenly spread; a larger number makes the search denser.",
        least=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.angles[0] > self.angles[1]:
            raise InputError(f"angles: the smallest comes first, found {self.angles}")


TIE_DEFAULTS = TieOptions()


class AdjustOptions(Options):
    """Options of the adjustment."""

    model: Model = option(
        "auto",
        """Unknowns of each view; the last three act in the image. `auto`: a rotation and a translation, or an affine in
        the image where they leave a trend that the affine removes.""",
    )
    center: Literal["line", "projective"] = option(
        "line",
        """Centre of rotation of a view: the intersection of the rays of its middle line, or, as in the paper, the
        centre of a projective camera over the whole image, at about twice the distance: `--paper` sets it.""",
        only="--paper",
    )
    drift: int | None = option(
        None,
        """Degree of the rotation as a polynomial of the image row, 0: constant. Without: 1 for models with a
        rotation, and 2 where the residuals require it.""",
        least=0,
        most=2,
    )
    jitter: str = option(
        "auto",
        """Splines along the rows of every image for attitude jitter. `auto`: where the residuals require them, check
        tie points improve and `drift` is not 0; `off`; or the number of rows between knots.""",
        unit="auto|off|rows",
    )
    detectors: tuple[float, ...] = option(
        (),
        """Column of every image at which another detector begins. Without: detected, with `jitter`, by steps of the
        residuals.""",
        unit="px",
        above=0,
    )
    terms: Literal["auto", "none"] = option(
        "auto",
        """Terms beside a rotation, a translation and a linear drift: `auto`, where all matches ask for them; or
        `none`.""",
    )
    sigma_attitude: float | None = option(
        None,
        """Prior standard deviation of the rotation, on the ground (angle x distance). Without: the accuracy that
        the RPC states where it is usable, else 7.5 m.""",
        unit="m",
        above=0,
    )
    sigma_position: float | None = option(
        None,
        """Prior standard deviation of the translation along an axis. Without: as for the attitude, or the accuracy
        stated by a radar's orbit and metadata.""",
        unit="m",
        above=0,
    )
    noise_floor: float = option(
        0.02,
        """Tie-point error common to a view, which does not average out: the information of all its observations
        together is at most 1 / noise_floor^2. 0 for independent errors.""",
        unit="px",
        least=0,
    )
    fixed: tuple[str, ...] = option((), "A view that keeps its delivered camera.", unit="name")
    dem_sigma: float = option(
        10.0,
        """Standard deviation of single heights of the DEM, until it is estimated from the tie points.""",
        unit="m",
        above=0,
    )
    dem_bias_sigma: float | None = option(
        None,
        """Standard deviation of the error common to all heights of the DEM, and of its tilts and bends at the scene's
        edges. Without: 5 m where their vertical datum is known, else 20 m (the effect of a missing geoid).""",
        unit="m",
        above=0,
    )
    min_convergence: float = option(
        1.0, "Tracks with a smaller convergence angle are constrained in height.", unit="deg", least=0, most=180
    )
    solver: Literal["auto", "sparse"] = option(
        "auto",
        """Up to 200 camera unknowns (22 views of nine) scipy's `least_squares` on the compressed problem, beyond, or
        with `sparse` always, a sparse Levenberg-Marquardt.""",
        removed={"scipy": "`auto` takes it for up to 200 unknowns"},
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.jitter in (AUTO, OFF) or self.spacing > 0):
            raise InputError(f"jitter {self.jitter!r} is not auto, off or a number of rows above 0")
        if (columns := list(self.detectors)) != sorted(set(columns)):
            raise InputError(f"detectors: columns ascend, found {columns}")
        if self.drift and "rotation" not in self.first_model:
            raise InputError(f"drift {self.drift} needs a model with a rotation, not {self.model!r}")

    @property
    def spacing(self) -> float:
        """Rows between the knots of splines that were asked for; 0 for none."""
        try:
            return float(checked("jitter", float, Rule("", above=0), float(self.jitter)))
        except ValueError:
            return 0.0

    @property
    def first_model(self) -> str:
        """The model to start with."""
        return GEOMETRIC if self.model == AUTO else self.model

    @property
    def is_plain(self) -> bool:
        """Whether rotations are constant and no splines are requested: such a run reports the remaining trends."""
        return self.jitter == AUTO and self.drift == 0


class FitOptions(Options):
    """Options of fitting an RPC to a sensor model or to points."""

    method: Literal["auto", "ridge", "gauss-newton", "lcurve-joint"] = option(
        "auto",
        """`ridge`: QR compression and a noise-scaled ridge. `lcurve-joint`: the paper's solver, one h for col and
        row (78 unknowns). `gauss-newton`: the least squares of the error itself, for models without noise. `auto`:
        `ridge`, and `gauss-newton` where the certificate says that it is better.""",
        removed={
            "minimax": "it minimised the largest error, `gauss-newton` minimises the RMSE",
            "vendor-denominators": "it kept the denominators of the RPC under a model, `auto` fits them",
        },
    )
    grid: tuple[int, int, int] = option(
        (12, 12, 7), "Control points along col (or lon), row (or lat) and altitude.", least=4
    )
    space: Literal["image", "ground"] = option(
        "image",
        """Axes of the grid: (col, row, alt) at Chebyshev-Lobatto nodes, or as in the paper (lon, lat, alt) in even
        steps.""",
    )
    tolerance: float = option(
        0.01, "Largest error of a check point in one coordinate; a fit with more is refused.", unit="px", above=0
    )
    pole_margin: float = option(
        0.1,
        """Margin around the ground of the image, as a share of its half width, in which denominators stay above a tenth
        of their value at the centre, for use outside the image. With 0 the fit to a camera that cubics represent badly
        is often better.""",
        least=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (count := math.prod(self.grid)) > MOST_POINTS:
            raise InputError(f"grid {list(self.grid)}: {count} control points, at most {MOST_POINTS} are fitted to")


class RunOptions(Options):
    """Options of `barpc.adjust`: files, outputs, and the records of its stages."""

    tie: TieOptions = field(default_factory=TieOptions)
    adjust: AdjustOptions = field(default_factory=AdjustOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    images: Literal["vrt", "copy", "none"] = option(
        "vrt",
        """Image file with the corrected RPC: a small VRT that points at the untouched image, a full copy, or
        none.""",
    )
    rpc_formats: tuple[str, ...] = option(("txt",), "RPC files to write.", rows="barpc.rpcio.WRITABLE")
    grids: bool = option(
        False,
        """Write a localisation grid and a correction grid of every image; without, of those whose RPC misses the
        corrected camera by more than 0.02 px. RPCs that miss the fit's tolerance are no failure then.""",
    )
    stop_after: Literal["matching", "adjustment", "all"] = option(
        "all", "End early: after the tracks, or before RPCs are written."
    )
    keep_going: bool = option(
        False,
        """Continue where possible instead of stopping: leave out unusable files and images not tied to the largest
        connected group, and write RPCs that miss the fit's tolerance. Such a run ends with exit code 3.""",
    )
    overwrite: bool = option(False, "Replace the results of an earlier run in the same folder.")
    allow_remote: tuple[str, ...] = option(
        (),
        """A host from which images, the files beside them, the DEM and the reference may be read by URL; none
        without. `HOST` is that of `https://HOST/...`; a bucket is given as `s3://BUCKET` (or gs, az). Never taken from
        an options file.""",
        unit="host",
        only="--allow-remote",
    )
    matches: tuple[str, ...] = option(
        (),
        """Matches of pairs (CSV, npz, COLMAP, hloc, ASP), to be verified and registered; the other pairs are matched. A
        folder: of files LEFT__RIGHT of a pair.""",
        unit="file",
    )
    matches_only: bool = option(False, "Take the given matches as tie points as they are, and match nothing.")
    overlap_list: str | None = option(None, "Match only these pairs: two image names or paths a line.", unit="file")
    aoi: str | None = option(
        None,
        "Restrict tie points to polygons (GeoJSON, lon/lat); only image parts that can see them are read.",
        unit="file",
    )
    gcp: tuple[str, ...] = option(
        (),
        """Ground control points: CSV, GeoJSON, GeoPackage, Shapefile, image tags, or files of QGIS, ODM, MicMac, ENVI,
        ASP and Metashape.""",
        unit="file",
    )
    gcp_crs: str | None = option(
        None,
        """Reference system of ground points, whatever their files say: EPSG:32631, or with that of the heights,
        EPSG:26910+5703. Without: the file's own, else longitude and latitude on WGS84.""",
    )
    altimetry: tuple[str, ...] = option(
        (),
        """Heights without image coordinates (ICESat-2, GEDI, lidar): CSV of lon, lat, alt, perhaps sigma and sigma_flat
        [m]. They constrain the scene where most of them agree with the surface of the tie points.""",
        unit="file",
    )
    check_points: tuple[str, ...] = option(
        (), "Independent check points: not used in the adjustment, measured after it.", unit="file"
    )
    add_to: str | None = option(
        None,
        "A finished run to add the images to: only its images that overlap new ones are matched.",
        unit="dir",
    )
    update: bool = option(
        False,
        "With `add_to`: adjust all cameras together, and write those of that run that change; else they are held.",
    )
    calibration: tuple[str, ...] = option(
        (),
        "Calibration (`barpc calibrate`) of the images' sensor. Without: SENSOR.cal beside an image that states it.",
        unit="file",
    )
    dem: tuple[str, ...] = option(
        (),
        """Terrain heights: they constrain the scene's height and, as far as its relief allows, its position. Of
        several, the first with a height at a point counts.""",
        unit="file",
    )
    geoid: str | None = option(None, GEOID_HELP, unit="file")
    heights: str | None = option(None, HEIGHTS_HELP, unit="file")
    reference: tuple[str, ...] = option(
        (),
        """Correctly positioned orthoimage of any date, resolution and CRS: with the heights of `dem` it constrains the
        block. Of several, the first that covers a point counts.""",
        unit="file",
    )
    reference_sigma: float | None = option(
        None,
        """Standard deviation of the reference's own position along an axis. Without: a quarter of its pixel, but at
        least 0.5 m.""",
        unit="m",
        above=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.update and self.add_to is None:
            raise InputError("update is given without add_to: there is no run with cameras to update")
        if self.geoid is not None and not (self.dem or self.gcp or self.check_points):
            raise InputError("geoid is given without dem or ground points: there are no heights to convert")
        if self.reference and not self.dem:
            raise InputError("reference is given without dem: an orthoimage has no heights")
        if self.reference_sigma is not None and not self.reference:
            raise InputError("reference_sigma is given without reference")
        if self.matches_only and not self.matches:
            raise InputError("matches_only is given without matches: there would be no tie points")
        for host in self.allow_remote:
            if not HOST_PATTERN.fullmatch(host):
                raise InputError(f"allow_remote {host!r} is no HOST, HOST:PORT or s3://BUCKET")
        for name in ("overlap_list", "aoi"):
            if self.matches_only and getattr(self, name) is not None:
                raise InputError(f"{name} is given with matches_only: nothing is matched then; leave one of them out")


# --- derived from the records -----------------------------------------------------------------------------


PAPER: Mapping[str, Mapping[str, Any]] = {
    "adjust": {
        "model": "rotation+translation",
        "center": "projective",
        "drift": 0,
        "jitter": OFF,
    },
    "fit": {"method": "lcurve-joint", "space": "ground", "grid": (20, 20, 10)},
}
"""The method of Akiki et al. (2021), beyond which the defaults go: ``barpc.adjust(..., options=PAPER)``."""


_PARTS = 10  # of a dotted key: tables of options are three deep at most
_QUOTED = re.compile(
    r'#[^\n]*|"""(?:\\.|[^\\])*?"""|\'\'\'.*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'', re.DOTALL
)  # and comments
_DEEP = re.compile(rf"(?<![\w-])(?:[\w-]+[ \t]*\.[ \t]*){{{_PARTS}}}")


def read_options(path: str | Path, options: RunOptions | None = None) -> RunOptions:
    """Read options from a TOML file: top-level keys, and the tables [tie], [adjust], [fit].

    InputError where it does not exist or parse, or holds an unknown option or a value that it cannot have.
    """
    import tomllib  # most runs read none

    text = read_text(path, OPTIONS)
    if _DEEP.search(_QUOTED.sub("q", text)):  # tomllib keeps every beginning of a dotted key: the square of its parts
        raise InputError(f"{path}: not an options file (TOML): a key of more than {_PARTS} parts")
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a date or a number that is none is not its own class
        raise InputError(f"{path}: not an options file (TOML): {error}") from error
    return with_values(options or RunOptions(), data, str(path), of_file=True)


def file_options() -> list[str]:
    """Return the names of the options of a run that are paths of files and folders."""
    return [name for name, one in declared(RunOptions).items() if one.rule.unit in ("file", "dir")]
