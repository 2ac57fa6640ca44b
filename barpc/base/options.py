"""The options of a run: four records whose fields declare type, range, unit and meaning once.

A record checks what is put into it, whoever does it: Python, an options file, a flag, or `replace`. The flags of the
command line, the page of options, the JSON schema and `help(AdjustOptions)` are made of the same declarations.
"""

from __future__ import annotations

import math
import os
import re
import reprlib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache
from importlib import import_module
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from barpc.base.errors import InputError, UsageError
from barpc.base.remote import HOST_PATTERN
from barpc.base.safe_io import BYTES_PER_NUMBER, OPTIONS, TABLE, read_text

T = TypeVar("T")
OptionsRecord = TypeVar("OptionsRecord", bound="Options")

AUTO, OFF, GEOMETRIC = "auto", "off", "rotation+translation"
Model = Literal["auto", "rotation+translation", "rotation", "translation", "shift", "shift-drift", "affine"]

HOOK = r"[A-Za-z_][\w.]*:[A-Za-z_]\w*"  # a name in a module
_MAX_EXACT_INTEGER = 1 << 53  # whole numbers stay below: beyond, not every one has a double of its own
_REAL = 1e30  # no option is larger, or smaller and not 0: squares, and squares of them, are numbers then
GEOID_HELP = (
    "Geoid of the heights of a DEM or of ground points: `egm96`, `egm2008`, the file of a grid, or `none` for "
    "ellipsoidal heights. Without: the one that their file names."
)
HEIGHTS_HELP = "Vertical datum of heights in files that state none: `ellipsoidal`, `egm96`, `egm2008`, a geoid's grid."
LONGEST_MOVE = 22e3  # m along an axis: from the sea's deepest bottom to the highest ground
MOST_POINTS = (TABLE.most or 0) // (5 * BYTES_PER_NUMBER)
"""Control points of a fit: as many as a table of them may hold, five numbers each."""
_SHORT = reprlib.Repr()
_SHORT.maxstring, _SHORT.maxother = 60, 200


@dataclass(frozen=True)
class Rule:
    """Bounds, unit and meaning of a field."""

    help: str  # sentences; Markdown's back quotes mark code
    unit: str = ""  # of numbers; of texts what they are: "file", "dir", "name"
    least: float | None = None  # bounds of a number, or of each in a list
    above: float | None = None  # not reached
    most: float | None = None
    below: float | None = None  # not reached
    rows: str = ""  # the table whose keys are the values allowed, as module and name
    hook: bool = False  # or `module:name`, of a user's own
    removed: Mapping[str, str] = field(default_factory=dict)  # value of earlier releases -> what it was, what to use
    cli_only: bool = False  # given on the command line or in Python: no options file may set it
    metavar: str = ""  # names of the values on the command line, with the commas that stand between them

    def holds(self, number: float) -> bool:
        """Return whether a number lies within the bounds; NaN and the infinities do not."""
        return (
            math.isfinite(number)
            and (self.least is None or number >= self.least)
            and (self.above is None or number > self.above)
            and (self.most is None or number <= self.most)
            and (self.below is None or number < self.below)
        )

    def bounds(self) -> str:
        """Return the bounds and the unit in words, with a blank before them."""
        ends = {"at least": self.least, "above": self.above, "at most": self.most, "below": self.below}
        words = " and ".join(f"{word} {value:g}" for word, value in ends.items() if value is not None)
        if self.least is not None and self.most is not None:
            words = f"from {self.least:g} to {self.most:g}"
        return (f" {words}" if words else "") + (f" [{self.unit}]" if self.unit else "")

    def choices(self, kind: Any) -> tuple[Any, ...]:
        """Return the values allowed where they are listed: of a Literal, or the rows of a table; else none."""
        if get_origin(kind) is Literal:
            return get_args(kind)
        if self.rows:
            module, _, name = self.rows.rpartition(".")
            return tuple(getattr(import_module(module), name))
        return ()


_FREE = Rule("")


def option(default: T, help: str, **rule: Any) -> T:
    """Declare a field of an option record: its default, its meaning, and the rest of its `Rule`."""
    metadata = {"rule": Rule(" ".join(help.split()), **rule)}
    made: T = field(default=default, metadata=metadata)
    return made


@dataclass(frozen=True)
class Declared:
    """A field as declared: its type (without None), whether it may be None, its rule and its default."""

    kind: Any
    optional: bool
    rule: Rule
    default: Any


def declared(record: type[Options]) -> Mapping[str, Declared]:
    """Return the declaration of each field of an option record; a nested record has an empty rule."""
    kind: Any = record  # a class can be hashed
    found: Mapping[str, Declared] = _declared(kind)
    return found


@cache
def _declared(record: Any) -> Mapping[str, Declared]:
    hints, found = get_type_hints(record), {}
    for one in fields(record):
        kind, optional = hints[one.name], False
        if get_origin(kind) in (Union, UnionType):
            kind, optional = next(part for part in get_args(kind) if part is not NoneType), True
        default = one.default if one.default_factory is MISSING else one.default_factory()
        found[one.name] = Declared(kind, optional, one.metadata.get("rule", _FREE), default)
    return found


class Options:
    """Base of the option records (frozen dataclasses with ``repr=False``): checked when made, short when printed."""

    def __post_init__(self) -> None:
        for name, one in declared(type(self)).items():
            value = getattr(self, name)
            known = value is None if one.optional else bool(one.rule.rows) and value == one.default
            if not known:  # a default is a row of its table: it is not imported for that
                object.__setattr__(self, name, checked(name, one.kind, one.rule, value))

    def __repr__(self) -> str:
        known = declared(type(self))
        given = {name: getattr(self, name) for name in known}
        shown = (f"{name}={_SHORT.repr(v)}" for name, v in given.items() if v != known[name].default)
        return f"{type(self).__name__}({', '.join(shown)})"


def wanted(kind: Any, rule: Rule) -> str:
    """Return the values that a field may hold, in words."""
    parts = get_args(kind)
    if get_origin(kind) is tuple:
        count = "a list" if parts[-1] is ... else f"{len(parts)} values"
        return f"{count}, each {wanted(parts[0], rule)}"
    if choices := rule.choices(kind):
        return f"one of {', '.join(map(str, choices))}" + (", or module:name" if rule.hook else "")
    words = {
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: f"a {rule.unit}" if rule.unit else "text",
    }
    return words.get(kind, f"of class {kind.__name__}") + (rule.bounds() if kind in (int, float) else "")


def checked(name: str, kind: Any, rule: Rule, value: Any) -> Any:
    """Return a value converted to its field's type; InputError names the field where type or range is wrong."""
    parts, found = get_args(kind), None
    if get_origin(kind) is tuple and rule.unit == "file" and isinstance(value, (str, os.PathLike)):
        value = (value,)  # of files one is as good as a list of one
    if get_origin(kind) is tuple:
        value = value.tolist() if hasattr(value, "tolist") else value  # numpy's arrays
        if isinstance(value, (list, tuple)) and (parts[-1] is ... or len(parts) == len(value)):
            return tuple(checked(name, parts[0], rule, item) for item in value)
    elif rule.hook and isinstance(value, str) and re.fullmatch(HOOK, value):
        found = value
    elif choices := rule.choices(kind):
        if type(value) not in (str, int) or value not in choices:
            why = rule.removed.get(str(value))
            raise InputError(f"{name} {value!r} is not {wanted(kind, rule)}" + (f"; removed: {why}" if why else ""))
        found = value
    else:
        found = _as_type(kind, rule, value)
    if found is None:
        raise InputError(f"{name} must be {wanted(kind, rule)}, found {value!r}")
    return found


def _as_type(kind: Any, rule: Rule, value: Any) -> Any:
    """Return a single value as its type, numpy's numbers and paths included; None if it is none, or out of range."""
    if kind is str:
        text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
        return text if isinstance(text, str) else None
    if kind not in (int, float):
        return value if isinstance(value, kind) else None
    if isinstance(value, bool) or not isinstance(value, Integral if kind is int else Real):
        return None
    if isinstance(value, Integral) and abs(int(value)) >= _MAX_EXACT_INTEGER:
        return None
    number = kind(value)
    beyond = kind is float and number != 0 and not _is_allowed_size(number)
    return number if rule.holds(number) and not beyond else None


def _is_allowed_size(number: float) -> bool:
    """Return whether the size of a number other than 0 is one that options allow."""
    return 1 / _REAL <= abs(number) <= _REAL


# --- the records ------------------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False)
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


@dataclass(frozen=True, repr=False)
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
        centre of a projective camera over the whole image, at about twice the distance.""",
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
    sigma_attitude: float | None = option(
        None,
        """Prior standard deviation of the rotation, on the ground (angle x distance). Without: the accuracy that
        the RPC states where it is usable, else 7.5 m.""",
        unit="m",
        above=0,
    )
    sigma_position: float | None = option(
        None,
        """Prior standard deviation of the translation along an axis; of a radar's range and position along the flight.
        Without: as for the attitude, or the accuracy stated by a radar's orbit and metadata.""",
        unit="m",
        above=0,
    )
    learn_priors: bool = option(
        True,
        """Widen the priors of rotation and translation where the corrections contradict them, for all views or
        single ones, and estimate that of the drift.""",
    )
    noise_floor: float = option(
        0.02,
        """Tie-point error common to a view, which does not average out: the information of all its observations
        together is at most 1 / noise_floor^2. 0 for independent errors.""",
        unit="px",
        least=0,
    )
    loss: Literal["geman_mcclure", "linear"] = option(
        "geman_mcclure",
        "Robust loss of the first rounds; `linear` skips them.",
        removed=dict.fromkeys(("huber", "soft_l1", "cauchy"), "`geman_mcclure` is the loss that is kept"),
    )
    estimate_noise: bool = option(True, "Scale the observations' sigmas by the scatter of the residuals.")
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
    solver: Literal["auto", "scipy", "sparse"] = option(
        "auto",
        """scipy's `least_squares` on the compressed problem, or a sparse Levenberg-Marquardt; `auto` takes scipy's for
        up to 200 camera unknowns (22 views of nine).""",
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
            rows = float(self.jitter)
        except ValueError:
            return 0.0
        return rows if _is_allowed_size(rows) else 0.0

    @property
    def first_model(self) -> str:
        """The model to start with."""
        return GEOMETRIC if self.model == AUTO else self.model

    @property
    def is_plain(self) -> bool:
        """Whether rotations are constant and no splines are requested: such a run reports the remaining trends."""
        return self.jitter == AUTO and self.drift == 0


@dataclass(frozen=True, repr=False)
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
    precision: Literal["nitf", "rpcm"] | None = option(None, "Fit coefficients to the few digits of a format.")
    localisation: bool = option(
        False,
        """Fit the localisation RPC, too: lon, lat as quotients of cubics of col, row and altitude; txt, json and vrt
        files store it.""",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (count := math.prod(self.grid)) > MOST_POINTS:
            raise InputError(f"grid {list(self.grid)}: {count} control points, at most {MOST_POINTS} are fitted to")


@dataclass(frozen=True, repr=False)
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
    resample: bool = option(
        False, "Also write every image resampled, so that one RPC represents its camera, and its correction grid."
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
        cli_only=True,
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
        "With `add_to`: also write changed cameras of that run.",
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
        "learn_priors": False,
        "solver": "scipy",
    },
    "fit": {"method": "lcurve-joint", "space": "ground", "grid": (20, 20, 10)},
}
"""The method of Akiki et al. (2021), beyond which the defaults go: ``with_values(RunOptions(), PAPER)``."""


@dataclass(frozen=True, repr=False)
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


@dataclass(frozen=True, repr=False)
class OrthoOptions(HeightOptions):
    """Options of `barpc.ortho`."""

    gsd: float | None = option(None, "Side of a pixel. Without: that of the finest image.", unit="m", above=0)
    crs: str | None = option(None, "Map projection in metres. Without: the UTM zone of the first image.", unit="name")
    overwrite: bool = option(False, "Replace orthoimages of an earlier call.")


@dataclass(frozen=True, repr=False)
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


@dataclass(frozen=True, repr=False)
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


@dataclass(frozen=True, repr=False)
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


def with_values(
    options: OptionsRecord, values: Mapping[str, Any], where: str = "options", *, of_file: bool = False
) -> OptionsRecord:
    """Return a copy of a record with some fields changed, nested records by nested mappings.

    InputError for an unknown field, or a value of the wrong type or out of range, of the source called `where`; of a
    file (`of_file`) also for a host, or a module that would be run.
    """
    known, changed = declared(type(options)), dict(values)
    for name, value in values.items():
        if name not in known:
            raise InputError(f"{where}: unknown option {name!r}; known are {', '.join(known)}")
        nested, rule = getattr(options, name), known[name].rule
        runs = rule.hook and isinstance(value, str) and re.fullmatch(HOOK, value)
        if of_file and (rule.cli_only or runs):
            why = f"{value!r} would run code, which" if runs else "is set by a file of unknown origin, which"
            raise InputError(f"{where}: {name} {why} is not accepted; give the flag --{name.replace('_', '-')}")
        if isinstance(nested, Options):
            if not isinstance(value, Mapping):
                raise InputError(f"{where}: [{name}] must be a table, found {value!r}")
            changed[name] = with_values(nested, value, f"{where} [{name}]", of_file=of_file)
    try:
        return replace(options, **changed)  # type: ignore[type-var]  # children are dataclasses
    except InputError as error:
        raise type(error)(f"{where}: {error}") from error


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


def schema(record: type[Options] = RunOptions) -> dict[str, Any]:
    """Return the JSON schema (2020-12) of a record, as an options file spells it."""
    import msgspec

    return msgspec.json.schema(_spelled(record))


def _spelled(record: type[Options]) -> Any:
    """Return the type of a record's table in an options file."""
    from msgspec import UNSET, Meta, UnsetType, defstruct

    rows: list[Any] = []
    for name, one in declared(record).items():
        rule, kind = one.rule, one.kind
        if rule.cli_only:
            continue
        if isinstance(one.default, Options):
            rows.append((name, _spelled(type(one.default)), {}))
            continue
        origin, parts = get_origin(kind), get_args(kind)
        item = parts[0] if origin is tuple else kind
        if item in (int, float):
            ends: Any = {"ge": rule.least, "gt": rule.above, "le": rule.most, "lt": rule.below}
            limited: Any = Annotated[item, Meta(**ends)]
        else:
            limited = Literal[rule.choices(item)] if rule.choices(item) else item
        if origin is tuple:
            limited = origin[tuple(... if part is ... else limited for part in parts)]
        default = UNSET if one.default is None else one.default  # TOML has no null
        rows.append((name, Annotated[limited | UnsetType, Meta(description=rule.help)], default))
    return defstruct(record.__name__, rows, forbid_unknown_fields=True)


def _documented(record: type[Options]) -> str:
    rows = []
    for name, one in declared(record).items():
        rows += [f"{name} : {wanted(one.kind, _FREE if one.rule.rows else one.rule)}"]
        rows += [f"    {one.rule.help or 'See there.'} Default: {one.default!r}."]
    return "\n".join([str(record.__doc__), "", "Parameters", "----------", *rows])


for _record in (*Options.__subclasses__(), *HeightOptions.__subclasses__()):
    _record.__doc__ = _documented(_record)


def file_options() -> list[str]:
    """Return the names of the options of a run that are paths of files and folders."""
    return [name for name, one in declared(RunOptions).items() if one.rule.unit in ("file", "dir")]
