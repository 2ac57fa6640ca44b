"""Opening a raster: one regular local file, one driver, nothing fetched.

GDAL decides by content what a file is, and some contents (a VRT, a web service description) make it
read other files or the network. So the first bytes choose the one driver that may open a file, GDAL does not
look at the files beside it, and a VRT is not GDAL's affair at all: it is read here (`barpc.vrt`), each of
its sources is opened as any other raster, and the pixels are put together in `barpc.mosaic`.
"""

from __future__ import annotations

import os
import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from barpc.errors import ImageError
from barpc.mosaic import Mosaic
from barpc.vrt import MAGIC, read_vrt

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
    MAGIC: "VRT",
}
"""First bytes of a file -> the driver that may open it."""

GDAL_OPTIONS: dict[str, Any] = {
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",  # nothing is fetched
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{noext}",
    "GDAL_HTTP_MAX_RETRY": 0,
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "GDAL_CACHEMAX": 64,  # MB
}
"""Settings under which every raster is read."""
_ALONE: dict[str, Any] = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO"}
# An .ovr, .msk or .aux.xml beside an image may be, or name, a web service: GDAL is told that there is none.

_INDIRECT = re.compile(r"/vsi|[A-Za-z][A-Za-z0-9+._-]+:")
_WARNINGS = threading.Lock()  # catch_warnings is process-wide


@contextmanager
def open_raster(path: str | os.PathLike[str], driver: str | None = None) -> Iterator[Any]:
    """Open a raster read-only; an error while it is open names the file, too.

    Parameters
    ----------
    path : path
        An existing regular file.
    driver : str, optional
        The one that may open it, of a kind whose first bytes do not tell (`barpc.dem.HEIGHTS`).

    Yields
    ------
    dataset : rasterio.DatasetReader or Mosaic
        Open until the block ends.

    Raises
    ------
    ImageError
        The file is missing, a folder, empty, of a kind that barpc does not read, damaged, remote, or a
        VRT that is not of the grammar of `barpc.vrt` or points at anything else than plain local rasters.
    """
    name = os.fspath(path)
    file, driver = identify(name, driver)
    try:
        with (
            rasterio.Env(**GDAL_OPTIONS, **_ALONE),
            _mosaic(file, name) if driver == "VRT" else _opened(file, driver) as dataset,
        ):
            yield dataset
    except RasterioError as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise ImageError(f"{name}: cannot be read as {driver}: {reason}") from error


def _opened(file: Path, driver: str) -> Any:
    with _WARNINGS, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return rasterio.open(file, driver=driver)


def _mosaic(file: Path, name: str) -> Mosaic:
    """A VRT whose sources are all rasters that are read here."""
    vrt = read_vrt(file, name=name)
    drivers: dict[Path, str] = {}
    for source in vrt.sources:
        if source.file not in drivers:
            drivers[source.file] = identify(source.file)[1]
            if drivers[source.file] == "VRT":
                raise ImageError(f"{name}: a VRT of a VRT is not read; give the images it is made of")
    return Mosaic(name, vrt, lambda source: _opened(source, drivers[source]))


def identify(path: str | os.PathLike[str], driver: str | None = None) -> tuple[Path, str]:
    """The absolute path of a raster and the only driver that may open it: `driver`, or what its first bytes say.

    Raises
    ------
    ImageError
        As for `open_raster`.
    """
    name = os.fspath(path)
    file = Path(name).absolute()
    try:
        if not file.exists():
            remote = _INDIRECT.match(name)
            raise ImageError(
                f"{name}: {'remote and virtual paths are not read' if remote else 'no such file'}"
            )
        if not file.is_file():
            raise ImageError(f"{name}: {'a folder' if file.is_dir() else 'a device or pipe'}, not an image")
        with file.open("rb") as stream:
            head = stream.read(64)
    except (OSError, ValueError) as error:
        if isinstance(error, ImageError):
            raise
        raise ImageError(f"{name}: cannot be read: {error}") from error
    if not head:
        raise ImageError(f"{name}: the file is empty")
    driver = driver or next((driver for magic, driver in DRIVERS.items() if head.startswith(magic)), None)
    if driver is None:
        known = ", ".join(sorted(set(DRIVERS.values())))
        raise ImageError(f"{name}: not a raster that is read here (kinds known: {known})")
    return file, driver
