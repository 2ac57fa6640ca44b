"""The hand-off: every file that was written is opened again as its consumers open it, and compared.

A file that barpc reads back is no proof that another tool does. Each consumer of `CONSUMERS` reads a file
in its own way; what it projects is compared with the model that the file should hold, on a grid over the
image and its altitudes. A vendor's file beside an image, which would be read in its place, is named.
"""

from __future__ import annotations

import errno
import json
import sys
import tempfile
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import RPCTransformer

from barpc.base.errors import OutputError, out_of_memory
from barpc.base.geodesy import Array, wrap_longitude
from barpc.cameras import open_camera
from barpc.rasters.raster import GDAL_OPTIONS
from barpc.rasters.vrt import Named, Vrt, read_vrt, vrt_text
from barpc.rpcio import Carrier, format_for, read_rpc, sidecars
from barpc.rpcio.formats import CORRECTION, GRID_SUFFIX
from barpc.sensor.csm import STATE_END
from barpc.sensor.direct_grid import DirectGrid
from barpc.sensor.sampler import NEGLIGIBLE_FIT_ERROR, Projection, Sample, Scattered

READING_TOLERANCE = NEGLIGIBLE_FIT_ERROR  # Largest difference [px] between a file and its model that passes


@dataclass(frozen=True)
class Reading:
    """Result of reading one file by one of `CONSUMERS`.

    `max_error`: largest distance to the model over the grid [px], NaN where it was not read; `note`: why it was not.
    `rms`: of the distances at the points of a sample [px], where there is one.
    """

    path: Path
    consumer: str
    max_error: float
    note: str = ""
    rms: float = float("nan")

    @property
    def passed(self) -> bool:
        """Whether the consumer sees the camera that was meant."""
        return bool(self.max_error <= READING_TOLERANCE)


def verify(paths: Sequence[Path | str], sample: Sample) -> list[Reading]:
    """Open the files of one image as their consumers do, and compare their projections with a camera's sample.

    Returns a reading for each file and each consumer that reads its kind and is installed; OutputError where the
    camera sees no point of its own image.
    """
    if not len(sample.ground):
        raise OutputError("hand-off: the model projects no ground point into its own image")

    def measured(_: Consumer, read: Projection) -> tuple[float, float]:
        return sample.compare(read), float("nan")

    return [reading for path in map(Path, paths) for reading in _consumer_readings(path, measured)]


def verify_grid(path: Path, sample: Scattered) -> list[Reading]:
    """Open a file of more than an RPC as its consumers do, and find its largest error against a model's sample.

    It is a localisation grid, a correction grid or a camera state, by the end of its name.
    """

    def measured(consumer: Consumer, read: Projection) -> tuple[float, float]:
        errors = sample.compare(read, consumer.locates)
        return errors.far, errors.rms

    return _consumer_readings(path, measured)


def projection_by(tool: str, path: Path) -> Projection:
    """Return the projection of a file's camera as a tool of `CONSUMERS` reads it, with the errors of that tool."""
    return CONSUMERS[tool].open(path)


def unverified(paths: Sequence[Path | str]) -> list[str]:
    """Return a sentence for each kind of these files that no installed tool but barpc reads."""
    # the readers of a state are no packages
    files = [path for path in map(Path, paths) if not path.name.endswith(STATE_END)]
    kinds = {path.suffix: path for path in files if not any(_tools_of(path).values())}
    return [
        f"{path}: only barpc itself has read it ({kind}: {' and '.join(_tools_of(path)) or 'no other tool'} would, and "
        "is not installed)"
        for kind, path in kinds.items()
    ]


_MACHINE = frozenset(
    getattr(errno, name) for name in ("EIO", "ENOSPC", "EDQUOT", "EMFILE", "ENFILE", "EROFS") if hasattr(errno, name)
)


def _consumers(path: Path) -> dict[str, Consumer]:
    """Return the tools that read a file, those that are not installed too; barpc last."""
    for end, consumers in _GRIDS.items():
        if path.name.endswith(end):
            return consumers
    row = format_for(path)
    return {name: CONSUMERS[name] for name in (*(() if row is None else row.consumers), "barpc")}


def _tools_of(path: Path) -> dict[str, bool]:
    """Return the tools besides barpc that read a file, and whether they are installed."""
    return {name: one.installed for name, one in _consumers(path).items() if one.package != "barpc"}


def _consumer_readings(path: Path, measure: Callable[[Consumer, Projection], tuple[float, float]]) -> list[Reading]:
    """Read a file with all consumers; those that are not barpc get it in a folder of its own.

    OutputError where the machine and not the file is to blame; whatever else a reader raises is its finding.
    """
    found = []
    with ExitStack() as stack:
        lent = cache(lambda: stack.enter_context(_lent(path)))
        for name, consumer in _consumers(path).items():
            if not consumer.installed:
                continue
            error, rms = float("nan"), float("nan")
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    error, rms = measure(consumer, consumer.open(path if name == "barpc" else lent()))
                note = "" if np.isfinite(error) else "it projects to no finite point"
            except Exception as failure:
                if out_of_memory(failure):
                    raise MemoryError from failure
                if isinstance(failure, OSError) and failure.errno in _MACHINE:
                    raise OutputError(f"{path}: cannot be opened as {name} does ({failure.strerror})") from failure
                note = " ".join(f"{type(failure).__name__}: {failure}".split())
            found.append(Reading(path, name, error, note, rms))
    return found


@contextmanager
def _lent(path: Path) -> Iterator[Path]:
    """A raster as a foreign reader may have it: beside it nothing but the RPC files that go before its own.

    An overview, a mask or an ``.aux.xml`` beside a file may be, or name, a web service, and so may the sources
    of a VRT: the pixels, which no consumer needs, are left out of it.
    """
    if not isinstance(format_for(path), Carrier):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        lent = Path(folder) / path.name
        if path.suffix.lower() == ".vrt":
            lent.write_text(_camera_only(read_vrt(path)))
        else:
            for file in (path, *(s.path for s in sidecars(path) if s.kind != "pam")):
                (Path(folder) / file.name).symlink_to(file.absolute())
        yield lent


def _camera_only(vrt: Vrt) -> str:
    blank = replace(vrt.bands[0], sources=())
    items = {"RPC": vrt.metadata.get("RPC", {})}
    return vrt_text(Vrt(vrt.size, (blank,), None, "", None, items, "", ()), lambda source: Named(str(source.file)))


# --- consumers --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Consumer:
    """A tool that reads RPCs: its package, and how it opens a file."""

    package: str
    open: Callable[[Path], Projection]
    locates: bool = False
    """Whether it gives ground points (N, 3) of col, row, altitude (N, 3) instead."""

    @property
    def installed(self) -> bool:
        """Whether its package can be imported."""
        return _is_installed(self.package)


@cache
def _is_installed(package: str) -> bool:
    return find_spec(package) is not None


def _transformer(rpcs: Any) -> Projection:
    def project(ground: Array) -> Array:
        lon = wrap_longitude(ground[:, 0], rpcs.long_off)
        with RPCTransformer(rpcs) as transformer:
            row, col = transformer.rowcol(lon, ground[:, 1], ground[:, 2], op=np.positive)
        return np.column_stack([col, row]) - 0.5  # GDAL counts from the corner of the first pixel

    return project


def _gdal_raster(path: Path | str) -> Projection:
    with warnings.catch_warnings(), rasterio.Env(**GDAL_OPTIONS):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            if dataset.rpcs is None:
                raise OutputError("no RPC")
            return _transformer(dataset.rpcs)


def _gdal_text(path: Path) -> Projection:
    """Return GDAL's reading of a text, beside an image of a single pixel as GDAL requires, both in memory."""
    stem = path.name[: -len("_rpc.txt")] if path.name.lower().endswith("_rpc.txt") else path.stem
    lend = partial(rasterio.MemoryFile, dirname=uuid.uuid4().hex)
    with lend(path.read_bytes(), filename=path.name), lend(_pixel_raster(), filename=f"{stem}.tif") as image:
        return _gdal_raster(image.name)


@cache
def _pixel_raster() -> bytes:
    with warnings.catch_warnings(), rasterio.MemoryFile() as file:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with file.open(driver="GTiff", width=1, height=1, count=1, dtype="uint8") as made:
            made.write(np.zeros((1, 1, 1), dtype=np.uint8))
        return bytes(file.read())


def _rpcm(path: Path) -> Projection:
    rpcm = import_module("rpcm.rpc_model")
    if path.suffix == ".json":
        model = rpcm.RPCModel(json.loads(path.read_text())["rpc"], dict_format="rpcm")
    else:
        carrier = isinstance(format_for(path), Carrier)
        model = (rpcm.rpc_from_geotiff if carrier else rpcm.rpc_from_rpc_file)(str(path))
    return lambda ground: np.column_stack(model.projection(*ground.T))


def _shareloc(path: Path) -> Projection:
    model = import_module("shareloc.geomodels.rpc").RPC.load(str(path))

    def project(ground: Array) -> Array:
        lon = wrap_longitude(ground[:, 0], model.offset_x)  # it adds no whole turns
        with _alone():
            row, col, _ = model.inverse_loc(lon, *np.ascontiguousarray(ground.T[1:]))
        return _within_shareloc_range(np.column_stack([col, row]), lon) - 0.5  # its first pixel's centre is (0.5, 0.5)

    return project


@contextmanager
def _alone() -> Iterator[None]:
    """Keep numba, if a reader has it, to one thread: others wait for their part of few points longer than they work."""
    if (numba := sys.modules.get("numba")) is None:
        yield
        return
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _within_shareloc_range(found: Array, lon: Array) -> Array:
    """Return the results (N, ...) of shareloc; OutputError where it fails beyond 180 degrees of longitude alone."""
    lost, beyond = ~np.isfinite(found).all(axis=1), np.abs(lon) > 180.0
    if lost.any() and not (lost & ~beyond).any():
        raise OutputError(
            f"shareloc takes no longitude beyond 180 degrees, where {lost.sum()} of {len(lon)} points lie"
        )
    return found


def _orthority(path: Path) -> Projection:
    camera = import_module("orthority.factory").RpcCameras.from_images((str(path),)).get(path.name)
    return lambda ground: np.asarray(camera.world_to_pixel(ground.T).T)


def _keyword_list(path: Path) -> Projection:
    """Return an OSSIM keyword list, read as its readers do: every line split at the first colon, all keys asked for."""
    pairs = dict(line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
    if pairs["type"].strip() != "ossimRpcModel" or pairs["polynomial_format"].strip() != "B":
        raise OutputError("type or polynomial_format is not one of OSSIM's")
    axes, sets = ("line", "samp", "lat", "long", "height"), ("line_num", "line_den", "samp_num", "samp_den")
    keys = (f"{axis}_{what}" for axis in axes for what in ("off", "scale"))
    values: dict[str, Any] = {key: float(pairs[key]) for key in keys}
    for key in (f"{name}_coeff" for name in sets):
        values[key] = [float(pairs[f"{key}_{i:02d}"]) for i in range(20)]
    return _transformer(rasterio.rpc.RPC(**values))


def _shareloc_grid(path: Path) -> Projection:
    model, own = import_module("shareloc.geomodels").GeoModel(str(path), "GRID"), open_camera(path).model

    def localize(at: Array) -> Array:
        found = np.asarray(model.direct_loc_h(at[:, 1] + 0.5, at[:, 0] + 0.5, at[:, 2]))
        lost = ~np.isfinite(found).all(axis=1)
        return _within_shareloc_range(found, own.localize(at[:, :2], at[:, 2])[:, 0]) if lost.any() else found

    return localize


def _own_grid(path: Path) -> Projection:
    return open_camera(path).model.project


def _linear_grid(path: Path) -> Projection:
    from scipy.interpolate import RegularGridInterpolator  # a quarter of a second, of grids alone

    grid = open_camera(path).model
    assert isinstance(grid, DirectGrid)
    lonlat = RegularGridInterpolator((grid.alts, grid.rows, grid.cols), grid.lonlat, bounds_error=False)
    return lambda at: np.column_stack([lonlat(at[:, ::-1]), at[:, 2]])


def _gdal_correction(path: Path) -> Projection:
    """Read a correction grid as a resampler does: values at the places that GDAL gives for its pixels' centres."""
    from scipy.interpolate import RegularGridInterpolator

    rpc = _gdal_raster(path)
    with rasterio.Env(**GDAL_OPTIONS), rasterio.open(path) as dataset:
        cols = np.array(dataset.xy(np.zeros(dataset.width), np.arange(dataset.width))[0]) - 0.5
        rows = np.array(dataset.xy(np.arange(dataset.height), np.zeros(dataset.height))[1]) - 0.5
        shift = RegularGridInterpolator((rows, cols), np.moveaxis(dataset.read(), 0, -1), bounds_error=False)
    ends = np.array([(rows[0], cols[0]), (rows[-1], cols[-1])])

    def project(ground: Array) -> Array:
        image = rpc(ground)
        return np.asarray(image + shift(np.clip(image[:, ::-1], *ends)))

    return project


CONSUMERS: dict[str, Consumer] = {
    "gdal": Consumer("rasterio", _gdal_raster),
    "gdal, beside an image": Consumer("rasterio", _gdal_text),
    "keywords": Consumer("rasterio", _keyword_list),
    "rpcm": Consumer("rpcm", _rpcm),
    "shareloc": Consumer("shareloc", _shareloc),
    "orthority": Consumer("orthority", _orthority),
    "barpc": Consumer("barpc", lambda path: read_rpc(path).project),
}
"""Consumer -> how it reads. Which formats it reads stands in their rows; those not installed are passed over."""

_GRIDS: dict[str, dict[str, Consumer]] = {
    GRID_SUFFIX: {
        "shareloc": Consumer("shareloc", _shareloc_grid, locates=True),
        "linear": Consumer("barpc", _linear_grid, locates=True),
        "barpc": Consumer("barpc", _own_grid),
    },
    CORRECTION: {"gdal": Consumer("rasterio", _gdal_correction), "barpc": Consumer("barpc", _own_grid)},
    STATE_END: {"barpc": Consumer("barpc", _own_grid)},
}
