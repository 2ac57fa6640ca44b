"""Opening a raster: one regular file, one driver, nothing fetched by GDAL.

GDAL decides by content what a file is, and some contents (a VRT, a web service description) make it read other
files or the network. So the first bytes choose the one driver that may open a file, GDAL does not look at the files
beside it, and a VRT or a list of tiles is never shown to it: `barpc.rasters.vrt` and `barpc.rasters.composed` read
it, and GDAL is shown a VRT written of that, in which every file stands with its one driver. Of a file on another
host, and of raw pixels with a header, GDAL asks this process for bytes: it sees nothing else, and only this process
speaks with the host.
"""

from __future__ import annotations

import os
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from rasterio import Affine
from rasterio._err import CPLE_BaseError
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError
from rasterio.warp import transform as warp_points
from rasterio.windows import Window

from barpc.base import identity
from barpc.base.errors import ImageError, InputError
from barpc.base.geodesy import Array, utm
from barpc.base.identity import Input
from barpc.base.remote import PathOrUrl, Remote, RemoteFile, location
from barpc.base.safe_io import IMAGE, opened, read_head
from barpc.rasters.composed import header_beside, is_raw, placed_tiles, refuse_foreign_channels, shown_header
from barpc.rasters.crs import crs_of, plain_crs, refuse_opening_crs
from barpc.rasters.vrt import GDAL_TYPES, INDIRECT, MAGIC, PROPERTIES, Band, Named, Source, Vrt, read_vrt, vrt_text

DRIVERS: dict[bytes, str] = {
    b"II*\x00": "GTiff",
    b"MM\x00*": "GTiff",
    b"II+\x00": "GTiff",
    b"MM\x00+": "GTiff",
    b"\x00\x00\x00\x0cjP  ": "JP2OpenJPEG",
    b"\xff\x4f\xff\x51": "JP2OpenJPEG",
    b"NITF": "NITF",
    b"NSIF": "NITF",
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"PCIDSK  ": "PCIDSK",
    b"bandId": "TIL",
    MAGIC: "VRT",
}
"""First bytes of a file -> the driver that may open it; raw pixels with an ENVI header have none."""
MOSAICS = ("VRT", "TIL")
"""Texts that name rasters, which GDAL is never shown."""

GRID_TAG = "ALTITUDE_B0"  # of a raster that is a localisation grid

GDAL_OPTIONS: dict[str, Any] = {
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",  # nothing is fetched
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{noext}",
    "GDAL_HTTP_MAX_RETRY": 0,
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "GDAL_CACHEMAX": 64 << 20,  # bytes, as rasterio sets it
    "GDAL_MAX_DATASET_POOL_SIZE": 64,  # sources of VRTs that are open at a time
    "GDAL_NUM_THREADS": "1",  # threads open the file anew: what fails in one of them nobody hears of
}
"""Settings under which every raster is read."""
_NO_SIDECAR_OPTIONS: dict[str, Any] = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO"}
# An .ovr, .msk or .aux.xml beside an image may be, or name, a web service: GDAL is told that there is none.
_LOOKS_BESIDE_JP2 = tuple(map(int, rasterio.__gdal_version__.split(".")[:2])) < (3, 10)
"""Whether GDAL looks for such files beside a JPEG 2000 in spite of that."""

_WARNINGS = threading.Lock()  # catch_warnings is process-wide


@contextmanager
def open_raster(path: str | os.PathLike[str], driver: str | None = None) -> Iterator[Any]:
    """Open a raster read-only, as a rasterio.DatasetReader; an error while it is open names the file, too.

    `driver` may open a file whose first bytes do not tell its kind (`barpc.rasters.dem.HEIGHT_DRIVERS`). ImageError for
    a file that is missing, a folder, empty, of no kind that barpc reads, damaged, remote, or a VRT that is not of the
    grammar of `barpc.rasters.vrt` or points at anything else than plain local rasters.
    """
    name = os.fspath(path)
    identity.ask(path)
    file, driver = identify(path, driver)
    try:
        with (
            rasterio.Env(**GDAL_OPTIONS, **_NO_SIDECAR_OPTIONS),
            _open_mosaic(file, driver, name) if driver in MOSAICS else _open_dataset(file, driver) as dataset,
        ):
            yield dataset
    except RasterioError as error:
        reason = " ".join(str(error.__cause__ or error).split())
        if driver == "GTiff" and (damage := _damage_of(file, reason)):
            raise ImageError(f"{name}: {damage}; copy it again") from error
        raise ImageError(f"{name}: cannot be read as {driver}: {reason}") from error


def _damage_of(file: PathOrUrl, reason: str) -> str:
    """Return the damage of a TIFF file by GDAL's message, in words; empty where that is another error."""
    directory = re.search(r"Failed to read directory at offset (\d+)", reason)
    size = 0 if isinstance(file, Remote) else file.stat().st_size
    if directory and 0 < size <= int(directory[1]):
        return f"is cut off after {size:,} bytes (its directory begins at {int(directory[1]):,})"
    return f"is cut off or damaged ({reason})" if directory or "TIFFReadEncoded" in reason else ""


def _open_dataset(file: PathOrUrl, driver: str) -> Any:
    _refuse_what_opens_others(file, driver)
    if isinstance(file, Remote):
        return _opened_remote(file, driver)
    return _opened_alone(file, driver) if _only_alone(driver) else _opened_quietly(file, driver=driver)


def _refuse_what_opens_others(file: PathOrUrl, driver: str) -> None:
    refuse_opening_crs(file, driver)
    if driver == "PCIDSK":
        refuse_foreign_channels(file)


def _only_alone(driver: str) -> bool:
    return driver == "ENVI" or (driver == "JP2OpenJPEG" and _LOOKS_BESIDE_JP2)


def _opened_quietly(name: str | Path, **how: Any) -> Any:
    with _WARNINGS, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        dataset = rasterio.open(name, **how)
    if dataset.tags(ns="OVERVIEWS"):  # GDAL opens what they name, by whatever driver, once it reads every second pixel
        dataset.close()
        raise RasterioError("it names another file as its overviews")
    return dataset


class _Asked(RemoteFile):
    """A file object that GDAL reads from; failures are kept for `_opened_remote`, as GDAL takes no exception."""

    def __init__(self, at: Remote, failures: list[OSError]) -> None:
        super().__init__(at)
        self._failures = failures

    def readinto(self, buffer: Any) -> int:
        if self._failures:
            return 0
        try:
            return super().readinto(buffer)
        except OSError as error:
            self._failures.append(error)
            return 0


_VISIBLE_NAME = "remote"  # the one file that GDAL finds, and, of raw pixels, its header


@contextmanager
def _opened_remote(file: Remote, driver: str) -> Iterator[Any]:
    """Some drivers make pixels of a file that ends too early: whatever they say, no failed reading ends well."""
    failures: list[OSError] = []
    try:
        with _open_visible(driver, {_VISIBLE_NAME: partial(_Asked, file, failures)}) as dataset:
            yield dataset
    except RasterioError:
        if not failures:
            raise
    if failures:
        raise ImageError(f"{file}: cannot be read ({failures[0]})") from failures[0]


def _open_visible(driver: str, files: Mapping[str, Callable[[], Any]]) -> Any:
    """Return a dataset of which GDAL sees these files and no other."""

    def opener(name: str, _mode: str = "rb", **_given: Any) -> Any:
        if name not in files:
            raise FileNotFoundError(name)
        return files[name]()

    return _opened_quietly(_VISIBLE_NAME, driver=driver, opener=opener)


@contextmanager
def _opened_alone(file: Path, driver: str) -> Iterator[Any]:
    """Open a file on disk so that GDAL sees no file beside it: only the header of raw pixels, written anew."""
    with ExitStack() as stack:
        files: dict[str, Callable[[], Any]] = {_VISIBLE_NAME: lambda: stack.enter_context(opened(file, IMAGE))}
        found = {}
        if driver == "ENVI":
            files[f"{_VISIBLE_NAME}.hdr"] = partial(BytesIO, shown_header(file))
            found = {"GDAL_DISABLE_READDIR_ON_OPEN": "TRUE"}
        with rasterio.Env(**found):  # not longer: other files may be opened meanwhile
            dataset = _open_visible(driver, files)
        with dataset:
            yield dataset


_PLAIN_PATH = re.compile(r"[\w/.~ ,@:\\()-]+")  # a path that vrt:// takes as it stands
_SHOWN_DOMAINS = "", "RPC"  # of metadata; others name files


@contextmanager
def _open_mosaic(file: PathOrUrl, driver: str, name: str) -> Iterator[Any]:
    """Open a VRT, or a list of tiles as one, by a new VRT in which every source has its one driver.

    By its first bytes alone a source could be another VRT to GDAL.
    """
    if isinstance(file, Remote):
        raise ImageError(f"{name}: a {driver} is read from disk only; give the images it is made of")
    vrt = read_vrt(file, name=name) if driver == "VRT" else _vrt_of_tiles(file)
    for text in filter(None, (vrt.srs, vrt.gcp_srs)):
        try:
            CRS.from_string(plain_crs(text, name, ImageError))
        except CRSError as error:
            raise ImageError(f"{name}: the VRT's coordinate system cannot be read ({error})") from error
    drivers = {source.file: identify(source.file)[1] for source in vrt.sources}
    if mosaics := set(drivers.values()).intersection(MOSAICS):
        raise ImageError(f"{name}: a {mosaics.pop()} of a VRT is not read; give the images it is made of")
    raw = "ENVI" in drivers.values()  # GDAL finds a header only where it looks beside every file: each is shown alone
    with ExitStack() as stack:
        with rasterio.Env(**{"GDAL_DISABLE_READDIR_ON_OPEN": "TRUE"} if raw else {}):
            files = {at: _vrt_source(at, kind, raw, stack) for at, kind in drivers.items()}
            bands = [_placed(band, files, vrt.size, name) for band in vrt.all]
            shown = replace(
                vrt,
                bands=tuple(bands[: len(vrt.bands)]),
                mask=bands[-1] if vrt.mask else None,
                metadata={domain: vrt.metadata.get(domain, {}) for domain in _SHOWN_DOMAINS},
            )
            text = vrt_text(shown, lambda source: files[source.file].named(source))
            dataset = stack.enter_context(_opened_quietly(text, driver="VRT"))
            if raw:
                _open_sources(dataset, shown)
        dataset.vrt = vrt
        yield dataset


def _open_sources(dataset: Any, vrt: Vrt) -> None:
    """Read a pixel of every source, so that GDAL opens it."""
    for band in vrt.all:
        for x, y, width, height in (source.dst or (0, 0, 1, 1) for source in band.sources):
            pixel = Window(max(x, 0), max(y, 0), 1, 1)
            if pixel.col_off < min(x + width, vrt.size[0]) and pixel.row_off < min(y + height, vrt.size[1]):
                dataset.read(window=pixel)
                dataset.read_masks(window=pixel)


class _VrtSource(NamedTuple):
    """A source of a VRT: its name for GDAL, its size and its bands."""

    name: str
    size: tuple[int, int]
    dtypes: tuple[str, ...]
    units: tuple[str | None, ...]
    blocks: tuple[tuple[int, int], ...]
    held: bool  # open here as long as the VRT is

    @classmethod
    def of(cls, dataset: Any, driver: str, held: bool = False) -> _VrtSource:
        """Return the record of an opened file."""
        size, name = (dataset.width, dataset.height), f"vrt://{dataset.name}?if={driver}"
        return cls(name, size, dataset.dtypes, dataset.units, tuple(dataset.block_shapes), held)

    def named(self, source: Source) -> Named:
        """Return its name for GDAL, with the properties without which GDAL never closes a file."""
        if self.held:
            return Named(self.name)
        height, width = self.blocks[source.band - 1]
        texts = *map(str, (*self.size, width, height)), GDAL_TYPES[self.dtypes[source.band - 1]]
        return Named(self.name, properties=dict(zip(PROPERTIES, texts, strict=True)))


def _vrt_source(file: Path, driver: str, alone: bool, stack: ExitStack) -> _VrtSource:
    """Return a source; one that GDAL has to see alone is opened on the stack."""
    _refuse_what_opens_others(file, driver)
    if alone or _only_alone(driver) or not _PLAIN_PATH.fullmatch(str(file)):
        return _VrtSource.of(stack.enter_context(_opened_alone(file, driver)), driver, held=True)
    found = file.stat()
    return _plain_file(file, driver, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)


@lru_cache(4096)  # a DEM of many tiles is opened for every window
def _plain_file(file: Path, driver: str, *_version: int) -> _VrtSource:
    with _opened_quietly(file, driver=driver) as dataset:
        return _VrtSource.of(dataset, driver)


def _placed(band: Band, files: Mapping[Path, _VrtSource], size: tuple[int, int], name: str) -> Band:
    """Return a band with all rectangles of its sources, and, where it states none, the unit of the first one."""
    sources = []
    for source in band.sources:
        file = files[source.file]
        if not 1 <= source.band <= len(file.dtypes):
            raise ImageError(f"{name}: there is no band {source.band} in {os.fspath(source.file)}")
        src, dst = source.src or (0, 0, *file.size), source.dst or (0, 0, *size)
        if src[2:] != dst[2:]:
            raise ImageError(
                f"{name}: {os.fspath(source.file)} is {src[2]} x {src[3]} px and would be resampled to {dst[2]} x "
                f"{dst[3]} px, which is not done; write it out as a GeoTIFF"
            )
        sources.append(replace(source, src=src, dst=dst))
    first = next(iter(sources), None)
    unit = files[first.file].units[first.band - 1] if band.unit is None and first else band.unit
    return replace(band, sources=tuple(sources), unit=unit)


def _vrt_of_tiles(file: Path) -> Vrt:
    """Return the VRT of a list of tiles, whose bands and place are those of its first tile."""
    placed = placed_tiles(file)
    first = min(placed, key=lambda tile: placed[tile][:2])
    if identify(first)[1] in MOSAICS:
        raise ImageError(f"{file}: its tile {first.name} is no image")
    with open_raster(first) as tile:
        whole = vrt_of(tile, first)
    bands = tuple(
        replace(band, sources=tuple(Source(tile, n, dst=place) for tile, place in placed.items()))
        for n, band in enumerate(whole.bands, 1)
    )
    size = max(x + width for x, _, width, _ in placed.values()), max(y + h for _, y, _, h in placed.values())
    return replace(whole, size=size, bands=bands, mask=None)


def vrt_of(dataset: Any, file: Path) -> Vrt:
    """Return the VRT that shows an opened raster whole; of one that is a VRT its own."""
    own: Vrt | None = getattr(dataset, "vrt", None)
    if own is not None:
        return own
    whole = (0, 0, dataset.width, dataset.height)
    rows = zip(dataset.dtypes, dataset.nodatavals, dataset.colorinterp, strict=True)
    bands = tuple(
        Band(dtype, nodata, nodata or 0.0, color.name, None, (1.0, 0.0), (Source(file, n, False, whole, whole),))
        for n, (dtype, nodata, color) in enumerate(rows, 1)
    )
    mask = Band("uint8", None, 0.0, "undefined", None, (1.0, 0.0), (Source(file, 1, True, whole, whole),))
    crs = earth_crs(dataset)
    srs = "" if crs is None else crs.to_wkt()
    transform = tuple(dataset.transform.to_gdal()) if srs else None
    return Vrt((dataset.width, dataset.height), bands, mask if has_mask(dataset) else None, srs, transform, {}, "", ())


def map_crs(given: str | None, middle: Array) -> CRS:
    """Return the requested CRS, in metres, or the UTM zone of a position."""
    if given is None:
        return CRS.from_string(utm(*middle[:2])[1])
    found = CRS.from_wkt(crs_of(given, f"--crs {given}").to_wkt())
    if not found.is_projected or found.linear_units_factor[1] != 1.0:
        raise InputError(f"--crs {given}: cells need a projected reference system in metres, such as EPSG:32631")
    return found


def reprojected(path: PathOrUrl | str, start: CRS, end: CRS, x: Array, y: Array) -> tuple[Array, Array]:
    """Return places (N,) in another CRS, NaN where there is none, as far from a map's zone.

    InputError, which names the file `path` that they are of, where one CRS does not lead to the other.
    """
    found, known = np.full((2, len(x)), np.nan), np.isfinite(x) & np.isfinite(y)
    try:
        try:
            found[:, known] = warp_points(start, end, x[known], y[known])
        except CPLE_BaseError:  # of one place: GDAL does not say of which
            from pyproj import Transformer

            to = Transformer.from_crs(start.to_wkt(), end.to_wkt(), always_xy=True)
            both = np.array(to.transform(x[known].tolist(), y[known].tolist()))
            known[known] = np.isfinite(both).all(axis=0)
            found[:, known] = warp_points(start, end, x[known], y[known])
    except (CRSError, CPLE_BaseError) as error:
        raise InputError(f"{path}: lon, lat cannot be brought into its CRS ({error})") from error
    return found[0], found[1]


def transformed(transform: Affine, x: Any, y: Any) -> tuple[Any, Any]:
    """Return coordinates x, y by an affine transformation: of arrays, which releases of `affine` multiply otherwise."""
    a, b, c, d, e, f = transform[:6]
    return a * x + b * y + c, d * x + e * y + f


def earth_crs(dataset: Any) -> CRS | None:
    """Return the CRS that places a raster on the Earth; None of a local one, which a JPEG 2000 without any is given."""
    found: CRS | None = dataset.crs
    return None if found is None or found.to_wkt().startswith(_LOCAL) else found


_LOCAL = "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS"


def has_mask(dataset: Any) -> bool:
    """Return whether a raster has a mask of its own, apart from an alpha band."""
    return MaskFlags.per_dataset in dataset.mask_flag_enums[0] and ColorInterp.alpha not in dataset.colorinterp


def hashed(path: PathOrUrl | str) -> Input:
    """Hash a file, of a VRT the sources that it shows, too; ImageError where one cannot be read."""
    try:
        if not isinstance(path, Remote):
            read_head(path, IMAGE, 1)  # no pipe, no device, and there
        whole = identity.fingerprint(path)  # before it is read: what it shows is what was hashed
        found = replace(whole, parts=tuple(map(identity.fingerprint, sources_of(path))))
    except OSError as error:
        if isinstance(error, ImageError):
            raise
        raise ImageError(f"{path}: cannot be read ({error.strerror or error})") from error
    found.ask()
    return found


def sources_of(path: PathOrUrl | str) -> tuple[PathOrUrl, ...]:
    """Return the files that a VRT or a list of tiles shows, the header of raw pixels; none for another raster.

    ImageError where it cannot be read.
    """
    driver = None if isinstance(path, Remote) else driver_at(path)
    if driver == "ENVI":
        return tuple(filter(None, [header_beside(Path(path))]))
    if driver == "TIL":
        return tuple(placed_tiles(Path(path)))
    return tuple(dict.fromkeys(source.file for source in read_vrt(Path(path)).sources)) if driver == "VRT" else ()


def identify(path: str | os.PathLike[str], driver: str | None = None) -> tuple[PathOrUrl, str]:
    """Return a raster's absolute path (or Remote) and the only driver that may open it, given or by its first bytes."""
    name = os.fspath(path)
    if not isinstance(path, Remote) and INDIRECT.match(name) and not os.path.lexists(name):
        raise ImageError(f"{name}: remote and virtual paths are not read")
    head = read_head(name, IMAGE, 64)  # (os.fspath leaves a Remote as it is)
    driver = driver or driver_at(name, head)
    if driver is None:
        raise ImageError(f"{name}: {unknown_kind(name)}")
    return location(path).absolute(), driver


def unknown_kind(path: PathOrUrl | str) -> str:
    """Return why a file is no raster to this package, in words."""
    if header := header_beside(location(path)):
        return f"not a raster that is read here (its length is not what {header.name} says of its pixels)"
    known = ", ".join(sorted({*DRIVERS.values(), "ENVI"}))
    return f"not a raster that is read here (kinds known: {known})"


def driver_of(head: bytes) -> str | None:
    """Return the driver for a file with these first bytes; None where no raster begins so."""
    return next((driver for magic, driver in DRIVERS.items() if head.startswith(magic)), None)


def driver_at(path: PathOrUrl | str, head: bytes | None = None) -> str | None:
    """Return the driver for a file by its first bytes, or by an ENVI header beside it; None where it is no raster."""
    driver = driver_of(read_head(path, IMAGE, 64) if head is None else head)
    return driver or ("ENVI" if is_raw(location(path)) else None)
