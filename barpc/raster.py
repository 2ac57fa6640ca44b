"""Opening a raster: one regular local file, one driver, nothing fetched.

GDAL decides by content what a file is, and some contents (a VRT, a web service description) make it
read other files or the network. So the first bytes choose the one driver that may open a file, only a VRT
that points at plain local rasters is let through, and GDAL does not look at the files beside an image.
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
from xml.etree import ElementTree

import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from barpc.errors import ImageError

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
    b"<VRTDataset": "VRT",
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

_VRT_TAGS = frozenset(
    [
        "VRTDataset",
        "SRS",
        "GeoTransform",
        "Metadata",
        "MDI",
        "GCPList",
        "GCP",
        "VRTRasterBand",
        "ColorInterp",
        "NoDataValue",
        "Description",
        "SimpleSource",
        "ComplexSource",
        "SourceFilename",
        "SourceBand",
        "SourceProperties",
        "SrcRect",
        "DstRect",
        "NODATA",
        "BlockXSize",
        "BlockYSize",
        "Offset",
        "Scale",
        "UnitType",
        "MaskBand",
        "ScaleOffset",
        "ScaleRatio",
    ]
)
_VRT_LIMIT = 1 << 20  # bytes; a VRT that carries an RPC takes a few thousand
_INDIRECT = re.compile(r"/vsi|[A-Za-z][A-Za-z0-9+._-]+:")
_WARNINGS = threading.Lock()  # catch_warnings is process-wide


@contextmanager
def open_raster(path: str | os.PathLike[str], *, sidecars: bool = False) -> Iterator[Any]:
    """Open a raster read-only; an error while it is open names the file, too.

    Parameters
    ----------
    path : path
        An existing regular file.
    sidecars : bool
        Let GDAL look at the files beside it: for files that barpc itself has written, never for inputs.

    Yields
    ------
    dataset : rasterio.DatasetReader
        Open until the block ends.

    Raises
    ------
    ImageError
        The file is missing, a folder, empty, of a kind that barpc does not read, damaged, remote, or a
        VRT that points at anything else than plain local rasters.
    """
    name = os.fspath(path)
    file, driver = identify(name)
    try:
        with rasterio.Env(**GDAL_OPTIONS, **({} if sidecars else _ALONE)):
            with _WARNINGS, warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                dataset = rasterio.open(file, driver=driver)
            with dataset:
                yield dataset
    except RasterioError as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise ImageError(f"{name}: cannot be read as {driver}: {reason}") from error


def identify(path: str | os.PathLike[str]) -> tuple[Path, str]:
    """The absolute path of a raster and the only driver that may open it.

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
    driver = next((driver for magic, driver in DRIVERS.items() if head.startswith(magic)), None)
    if driver is None:
        known = ", ".join(sorted(set(DRIVERS.values())))
        raise ImageError(f"{name}: not a raster that is read here (kinds known: {known})")
    if driver == "VRT":
        _check_vrt(file, name)
    return file, driver


def _check_vrt(file: Path, name: str) -> None:
    """Raise unless the VRT only stacks plain local rasters."""
    if file.stat().st_size > _VRT_LIMIT:
        raise ImageError(f"{name}: a VRT of more than {_VRT_LIMIT} bytes is not read")
    text = file.read_bytes()
    if b"<!" in text.replace(b"<!--", b""):  # DOCTYPE, ENTITY, CDATA
        raise ImageError(f"{name}: a VRT with a document type or raw data is not read")
    try:
        root = ElementTree.fromstring(text)  # noqa: S314  (no document type, size capped)
    except ElementTree.ParseError as error:
        raise ImageError(f"{name}: the VRT does not parse: {error}") from error
    for element in root.iter():
        if element.tag not in _VRT_TAGS or "subClass" in element.attrib:
            raise ImageError(f"{name}: a VRT with <{element.tag}> is not read; give the images it is made of")
        if element.tag == "SourceFilename":
            relative = element.get("relativeToVRT", "0") == "1"
            source = Path(file.parent if relative else "/") / (element.text or "")
            if _INDIRECT.match(element.text or "") or (
                not relative and not Path(element.text or "").is_absolute()
            ):
                raise ImageError(f"{name}: the VRT points at {element.text!r}, which is no plain local file")
            if identify(source)[1] == "VRT":
                raise ImageError(f"{name}: a VRT of a VRT is not read; give the images it is made of")
