"""Sentinel-1 products as delivered: SAFE folders and zips."""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from barpc.errors import BarpcError, InputError, RpcError, RpcFormatError
from barpc.safexml import MAX_BYTES
from barpc.sensor.sentinel1.annotation import Annotation, read_annotation
from barpc.sensor.sentinel1.build import from_annotation, mosaic
from barpc.sensor.sentinel1.corrections import Bistatic
from barpc.sensor.sentinel1.range_doppler import RangeDoppler
from barpc.sidefile import PRODUCT, opened, read_head

MOSAIC = "mosaic"
"""The swath of all swaths."""

_NAME = re.compile(r"s1[a-d]-(?P<swath>\w+)-(slc|grd)-(?P<pol>vv|hh|vh|hv)-.*\.xml", re.IGNORECASE)
_POLARISATIONS = ("vv", "hh", "vh", "hv")


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
    """The model of a Sentinel-1 product.

    Parameters
    ----------
    path : str or Path
        A ``.SAFE`` folder, its ``manifest.safe``, a ``.zip`` of it, or one annotation XML.
    swath : str, optional
        "iw1", "s3", ..., or "mosaic" for all of them; may be left out where there is one.
    polarisation : str, optional
        "vv", "vh", "hh" or "hv"; the geometry is the same, the first one is taken if left out.
    orbit : str or Path, optional
        Precise orbit file (``.EOF``).
    burst : int, optional
        One burst of the swath alone, from 0.
    atmosphere : bool
        Add the path delay of the atmosphere.
    bistatic : "annotated" or "full", optional
        Add a bistatic correction.

    Returns
    -------
    model : RangeDoppler
        With `size` [px] and `alt_range` [m].

    Raises
    ------
    InputError
        No such swath or polarisation, or a choice that does not go with the product; the message lists
        what there is.
    RpcFormatError
        Not a Sentinel-1 product.
    """
    try:
        return _open(Path(path), swath, polarisation, orbit, burst, atmosphere, bistatic)
    except RpcError as error:
        guilty = Path(path if orbit is None else orbit)
        if guilty.name in str(error):
            raise
        raise type(error)(f"{guilty}: {error}") from error


def _open(
    path: Path,
    swath: str | None,
    polarisation: str | None,
    orbit: str | Path | None,
    burst: int | None,
    atmosphere: bool,
    bistatic: Bistatic | None,
) -> RangeDoppler:
    found = _choose(path, polarisation)
    precise = None if orbit is None else Path(orbit)
    name = None if swath is None else swath.lower()
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
    annotation = found[name].read()
    return from_annotation(annotation, burst=burst, orbit=precise, atmosphere=atmosphere, bistatic=bistatic)


@dataclass(frozen=True, order=True)
class _File:
    """An annotation: its swath, its polarisation, and where it is."""

    swath: str
    polarisation: str
    path: Path
    member: str | None = None

    def read(self) -> Annotation:
        if self.member is None:
            return read_annotation(self.path)
        name = PurePosixPath(self.member).name
        try:
            with opened(self.path, PRODUCT) as archive, zipfile.ZipFile(archive).open(self.member) as file:
                data = file.read(MAX_BYTES + 1)
        except BarpcError:
            raise
        except Exception as error:
            raise RpcFormatError(f"{self.path}: {name} cannot be read from it ({error})") from error
        return read_annotation(data, name=name)


def _annotations(path: Path) -> list[_File]:
    """The annotations of a product, in order of swath and polarisation."""
    if path.name == "manifest.safe":
        path = path.parent
    if path.is_dir():
        names = [str(p.relative_to(path)) for p in path.glob("annotation/*.xml")]
        files = [_named(path / name, None) for name in names]
    elif read_head(path, PRODUCT, 4) in (b"PK\3\4", b"PK\5\6"):
        names = [name for name in _members(path) if PurePosixPath(name).parent.name == "annotation"]
        files = [_named(path, name) for name in names]
    else:
        annotation = read_annotation(path)
        files = [_File(annotation.swath.lower(), annotation.polarisation.lower(), path)]
    return sorted(file for file in files if file is not None)


def _members(path: Path) -> list[str]:
    try:
        with opened(path, PRODUCT) as file, zipfile.ZipFile(file) as archive:
            return archive.namelist()
    except BarpcError:
        raise
    except Exception as error:
        raise RpcFormatError(f"{path}: a zip file that cannot be read ({error})") from error


def _named(path: Path, member: str | None) -> _File | None:
    """The file, if its name is that of an annotation."""
    match = _NAME.fullmatch(path.name if member is None else PurePosixPath(member).name)
    return match and _File(match["swath"].lower(), match["pol"].lower(), path, member)


def _choose(path: Path, polarisation: str | None) -> dict[str, _File]:
    """Swath -> annotation, of one polarisation."""
    files = _annotations(path)
    if not files:
        raise RpcFormatError(f"{path}: no Sentinel-1 annotation (annotation/s1?-*.xml) in it")
    there = sorted({f.polarisation for f in files}, key=_POLARISATIONS.index)
    wanted = polarisation.lower() if polarisation else there[0]
    chosen = {f.swath: f for f in files if f.polarisation == wanted}
    if not chosen:
        raise InputError(f"{path}: no polarisation {wanted}; choose one of {', '.join(there)}")
    if len(chosen) < sum(f.polarisation == wanted for f in files):
        raise InputError(f"{path}: several images of one swath; give the annotation XML of one of them")
    return chosen
