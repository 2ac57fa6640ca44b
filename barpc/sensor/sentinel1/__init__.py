"""Sentinel-1: Range-Doppler models from the annotation XML alone.

`open_product` makes the model of a product (folder, zip, annotation), `RangeDoppler.from_annotation` that of one
file, `mosaic` that of several swaths. The rest says where bursts and swaths lie, and how the model agrees with the
product's own geolocation grid.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeVar

import numpy as np

from barpc.base.errors import BarpcError, InputError, RpcError, RpcFormatError, plain, visible
from barpc.base.geodesy import Array
from barpc.base.safe_io import MAX_XML, PRODUCT, opened, read_head, unread
from barpc.sensor.curve import fit_orbit
from barpc.sensor.document import seconds
from barpc.sensor.sentinel1.annotation import Annotation, burst_rows, read_annotation
from barpc.sensor.sentinel1.range_doppler import (
    Bistatic,
    GroundFrame,
    RangeDoppler,
    SlantFrame,
    grid_residuals,
    line_extent,
    swaths_model,
)

__all__ = [
    "Annotation",
    "GroundFrame",
    "RangeDoppler",
    "SlantFrame",
    "burst_rows",
    "fit_orbit",
    "grid_residuals",
    "mosaic",
    "mosaic_offsets",
    "open_product",
    "read_annotation",
]

T = TypeVar("T")
MOSAIC = "mosaic"  # the swath of all swaths
_RATE_TOLERANCE = 1e-9  # of the ratio of two swaths' sampling rates: 1 within a product
_ANNOTATION_PATTERN = re.compile(r"s1[a-d]-(?P<swath>\w+)-(slc|grd)-(?P<pol>vv|hh|vh|hv)-.*\.xml", re.IGNORECASE)
_POLARISATIONS = ("vv", "hh", "vh", "hv")


def mosaic(
    sources: Sequence[Path | Annotation],
    *,
    orbit: Path | None = None,
    atmosphere: bool = False,
    bistatic: Bistatic | None = None,
) -> RangeDoppler:
    """Return one model for the swaths of an SLC product, side by side.

    Column 0 is pixel 0 of the nearest swath (IW1, EW1) and row 0 the earliest line 0; the other swaths
    start at ``mosaic_offsets``.

    The rest is as of `RangeDoppler.from_annotation`. InputError for a GRD, swaths that are not of one product, or the
    full bistatic correction, which jumps between swaths.
    """
    swaths = [s if isinstance(s, Annotation) else read_annotation(s) for s in sources]
    if bistatic == "full":
        raise InputError("the full bistatic correction jumps between swaths: take one swath, or 'annotated'")
    offsets = mosaic_offsets(swaths)
    size = np.rint((offsets + [[a.samples, line_extent(a)[1]] for a in swaths]).max(axis=0))
    epoch = min(a.first_line_time for a in swaths)
    nearest_first = sorted(swaths, key=lambda a: a.slant_range_time)
    return swaths_model(nearest_first, epoch, (int(size[0]), int(size[1])), orbit, atmosphere, bistatic)


def mosaic_offsets(swaths: Sequence[Annotation]) -> Array:
    """Return the offsets col, row (S, 2) [px] of the stitched swaths of one SLC product in their mosaic.

    Whole numbers to within 1e-3 in products since 2016. InputError for a GRD, or swaths that are not of one product.
    """
    if not swaths:
        raise InputError("a mosaic of no swaths: give the annotations of IW1, IW2 and IW3")
    first = swaths[0]
    for other in swaths:
        if other.product_type != "SLC" or not other.bursts:
            raise InputError(f"{other.name}: a mosaic takes TOPS SLC swaths, this is {other.kind}")
        apart = abs(seconds(other.first_line_time, first.first_line_time))
        rates = (
            other.azimuth_time_interval / first.azimuth_time_interval,
            other.range_sampling_rate / first.range_sampling_rate,
        )
        late = apart > other.lines * other.azimuth_time_interval
        if other.mission != first.mission or late or max(abs(rate - 1.0) for rate in rates) > _RATE_TOLERANCE:
            raise InputError(f"{other.name}: not of the same product as {first.name}")
    near = min(a.slant_range_time for a in swaths)
    epoch = min(a.first_line_time for a in swaths)
    cols = [(a.slant_range_time - near) * a.range_sampling_rate for a in swaths]
    rows = [seconds(a.first_line_time, epoch) / a.azimuth_time_interval for a in swaths]
    return np.column_stack([cols, rows])


def open_product(
    path: str | Path,
    *,
    swath: str | None = None,
    polarisation: str | None = None,
    orbit: str | Path | None = None,
    burst: int | None = None,
    atmosphere: bool = False,
    bistatic: Bistatic | None = None,
) -> RangeDoppler:
    """Return the model of a Sentinel-1 product.

    Parameters
    ----------
    path : str or Path, a ``.SAFE`` folder, its ``manifest.safe``, a ``.zip`` of it, or one annotation XML
    swath : str, optional, "iw1", "s3", ..., or "mosaic" for all of them; may be left out where there is one
    polarisation : str, optional, "vv", "vh", "hh" or "hv"; the geometry is the same
    orbit, burst, atmosphere, bistatic : as of `RangeDoppler.from_annotation`

    Raises
    ------
    InputError
        No such swath or polarisation, or a choice that does not go with the product.
    RpcFormatError
        Not a Sentinel-1 product.
    """
    path, name = Path(path), None if swath is None else swath.lower()
    precise = None if orbit is None else Path(orbit)
    try:
        found = _choose(path, polarisation)
        if name == MOSAIC:
            if burst is not None:
                raise InputError(f"{path}: burst {burst} of the mosaic; choose one swath")
            swaths = [file.read() for file in found.values()]
            return mosaic(swaths, orbit=precise, atmosphere=atmosphere, bistatic=bistatic)
        if name is None and len(found) == 1:
            name = next(iter(found))
        if name not in found:
            wanted = "the product has several swaths" if name is None else f"no swath {name}"
            choices = [*sorted(found), MOSAIC] if len(found) > 1 else sorted(found)
            raise InputError(f"{path}: {wanted}; choose one of {', '.join(choices)}")
        return RangeDoppler.from_annotation(
            found[name].read(), burst=burst, orbit=precise, atmosphere=atmosphere, bistatic=bistatic
        )
    except RpcError as error:
        guilty = precise or path
        if guilty.name in str(error):
            raise
        raise type(error)(f"{guilty}: {error}") from error


class _File(NamedTuple):
    """An annotation: its swath, its polarisation, and how it is read."""

    swath: str
    polarisation: str
    read: Callable[[], Annotation]


def _read_member(path: Path, member: str) -> Annotation:
    name = PurePosixPath(member).name
    data = _from_zip(path, name, lambda archive: archive.open(member).read(MAX_XML + 1))
    return read_annotation(data, name=name)


def _from_zip(path: Path, what: str, use: Callable[[zipfile.ZipFile], T]) -> T:
    try:
        with opened(path, PRODUCT) as file, zipfile.ZipFile(file) as archive:
            return use(archive)
    except BarpcError:
        raise
    except Exception as error:
        raise RpcFormatError(f"{path}: {what} cannot be read ({plain(error)})") from error


def _annotations(path: Path) -> list[_File]:
    """Return the annotations of a product."""
    if path.name == "manifest.safe":
        path = path.parent
    if path.is_dir():
        readers = [(file.name, partial(read_annotation, file)) for file in path.glob("annotation/*.xml")]
    elif read_head(path, PRODUCT, 4) in (b"PK\3\4", b"PK\5\6"):
        places = [(PurePosixPath(one), one) for one in _from_zip(path, "a zip file that", zipfile.ZipFile.namelist)]
        inside = [(place.name, one) for place, one in places if place.parent.name == "annotation"]
        readers = [(name, partial(_read_member, path, one)) for name, one in inside]
    else:
        annotation = read_annotation(path)
        if (polarisation := annotation.polarisation.lower()) not in _POLARISATIONS:
            raise RpcFormatError(
                f"{path}: polarisation {visible(polarisation[:60])} is none of {', '.join(_POLARISATIONS)}"
            )
        return [_File(annotation.swath.lower(), polarisation, lambda: annotation)]
    known = ((_ANNOTATION_PATTERN.fullmatch(name), read) for name, read in readers)
    return [_File(match["swath"].lower(), match["pol"].lower(), read) for match, read in known if match]


def _choose(path: Path, polarisation: str | None) -> dict[str, _File]:
    files = _annotations(path)
    if not files:
        raise RpcFormatError(f"{path}: no Sentinel-1 annotation (annotation/s1?-*.xml) in it{unread(path)}")
    there = sorted({f.polarisation for f in files}, key=_POLARISATIONS.index)
    wanted = polarisation.lower() if polarisation else there[0]
    chosen = {f.swath: f for f in sorted(files, key=lambda f: f.swath) if f.polarisation == wanted}
    if not chosen:
        raise InputError(f"{path}: no polarisation {wanted}; choose one of {', '.join(there)}")
    if len(chosen) < sum(f.polarisation == wanted for f in files):
        raise InputError(f"{path}: several images of one swath; give the annotation XML of one of them")
    return chosen
