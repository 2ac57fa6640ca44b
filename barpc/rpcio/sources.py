"""Where an image's RPC comes from: the file itself, or one of the files beside it.

The order is GDAL's: a vendor's file beside an image goes before what the image itself carries, so that
barpc sees the camera that every other tool sees; last stands what GDAL shows of a raster of any other kind. What it
found, and what it passed over, is always said.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from barpc.base.errors import BarpcError, ImageError, MissingRpcError, RpcError, RpcFormatError
from barpc.base.remote import PathOrUrl, beside, location
from barpc.base.safe_io import IMAGE, RPC_FILE, encoding_of, read_bytes, read_head
from barpc.rasters.composed import tiles_of
from barpc.rasters.raster import MOSAICS, driver_at, earth_crs, identify, open_raster, unknown_kind
from barpc.rasters.vrt import read_vrt
from barpc.rpcio.formats import FORMATS, files_of, holds_physical, parse_rpc
from barpc.rpcio.images import read_domain, read_nitf, read_tag
from barpc.rpcio.text import ReadOptions, decode_text
from barpc.rpcio.xml import rpc_from_domain
from barpc.sensor.rpc import RPC


@dataclass(frozen=True)
class RpcSource:
    """An RPC and where it came from."""

    rpc: RPC
    format: str  # tag, nitf, domain, or a row of FORMATS
    path: PathOrUrl  # the file that holds it: the image, or one beside it
    notes: tuple[str, ...] = ()  # what the user should know: an origin that was applied, files passed over
    size: tuple[int, int] | None = None  # width and height [px] of the mosaic whose tiles a file lists


@dataclass(frozen=True)
class Sidecar:
    """A file beside an image that may hold an RPC."""

    kind: str  # rpb, txt, xml, dimap, alos, pam, geom or strip
    path: PathOrUrl
    before_tag: bool  # whether GDAL and its users read it instead of the image's own RPC


def sidecars(image: Path | str) -> list[Sidecar]:
    """Return the files beside an image that hold an RPC for some tool, in the order in which GDAL looks.

    Names are compared without regard to case, as GDAL does. XML files count only where their content is an RPC.
    """
    image = location(image)
    present = _present(image)
    found: list[Sidecar] = []
    metadata_only = f"{image.stem}.imd".lower() in present  # with it GDAL takes the image for Maxar's
    for kind, name, before_tag in _sidecar_names(image.name):
        found_name = present.get(name.lower())
        path = image.parent / (found_name or "")
        if found_name in (None, image.name) or not path.is_file():
            continue
        syntax = FORMATS[{"pam": "gdal", "dimap": "dimap"}.get(kind, "xml")]
        if path.suffix.lower() == ".xml" and not syntax.sniff(_readable(path)):
            continue
        if path not in [sidecar.path for sidecar in found]:
            found.append(Sidecar(kind, path, before_tag and (kind in ("rpb", "xml") or not metadata_only)))
    return found


def metadata_beside(image: Path) -> Path:
    """Return the XML beside an image that may hold its physical model: Maxar's or SPOT's, Airbus' ``DIM_*.XML``."""
    present, product = files_of(image.parent), image.stem[4:]  # of IMG_<product>_R1C1
    names = (f"{image.stem}.xml", f"dim_{product}.xml", f"dim_{product.rpartition('_')[0]}.xml")
    if (scene := scene_beside(image)) is not None:
        return scene
    for name in names:
        if name.lower() in present:
            return image.parent / present[name.lower()]
    raise ImageError(f"{image}: no metadata with a physical model beside it ({' or '.join(names[:2])})")


def scene_beside(image: Path) -> Path | None:
    """Return the ``.DIM`` of a SPOT scene: of the image's name, or ``METADATA.DIM`` beside ``IMAGERY.*``."""
    present = files_of(image.parent)
    for name in (f"{image.stem}.dim".lower(), *["metadata.dim"] * (image.stem.lower() == "imagery")):
        if name in present:
            return image.parent / present[name]
    return None


def stated_in_xml(path: PathOrUrl) -> tuple[tuple[int, int] | None, bool]:
    """Return the width and height [px] that a vendor's XML states, if so, and whether it holds a physical model."""
    text = decode_text(read_bytes(path, RPC_FILE))
    found = [
        re.search(rf"<(?:\w+:)?(?:{tag})>\s*+(\d{{1,7}})\s*+<", text) for tag in ("NUMCOLUMNS|NCOLS", "NUMROWS|NROWS")
    ]
    width, height = (int(one[1]) if one is not None else 0 for one in found)
    return ((width, height) if width and height else None), holds_physical(text)


def only_physical(path: Path) -> bool:
    """Return whether an XML holds a physical camera model and no RPC; not of one that cannot be read."""
    text = _readable(path)
    return holds_physical(text) and not any(row.sniff(text) for row in FORMATS.values())


def _present(image: PathOrUrl) -> Mapping[str, str]:
    """Return the files beside an image, by name in lower case; on another host those that count."""
    if isinstance(image, Path):
        return files_of(image.parent)
    try:
        return beside(image, [f"{image.stem}.IMD", *(name for _, name, _ in _sidecar_names(image.name))])
    except OSError as error:
        raise ImageError(
            f"{image}: its host does not say what lies beside it ({error}); name its camera: IMAGE,camera=URL"
        ) from error


def _sidecar_names(name: str) -> Iterator[tuple[str, str, bool]]:
    """Yield (kind, file name, read before the tag) of all sidecars that an image of this name may have."""
    stem = name.rpartition(".")[0] or name
    yield "rpb", f"{stem}.RPB", True
    yield "xml", f"{stem}.XML", True
    yield "txt", f"{stem}_RPC.TXT", True
    if len(stem) > 4:  # DIMAP: IMG_<product>_R1C1.TIF beside RPC_<product>.XML
        yield "dimap", f"RPC_{stem[4:]}.XML", True
        yield "dimap", f"RPC_{stem[4:].rpartition('_')[0]}.XML", True
    yield "txt", f"{stem}.rpc", True
    for cut in (6, 3):  # ALOS: IMG-01-<scene>.tif or IMG-<scene>.tif beside RPC-<scene>.txt
        if len(stem) > cut:
            yield "alos", f"RPC{stem[cut:]}.txt", True
    yield "pam", f"{name}.aux.xml", False
    yield "geom", f"{stem}.geom", False
    yield "rpb", f"{name}.RPB", False  # names that GDAL does not look for
    yield "rpb", f"{stem}_RPB.TXT", False
    yield "txt", f"{stem}-RPC.txt", False
    if strip := _strip_name(stem):
        yield "strip", f"{strip}.RPB", False
        yield "strip", f"{strip}.XML", False
        yield "strip", f"{strip}_RPC.TXT", False


def _readable(path: PathOrUrl) -> str:
    """Return the text of a file; empty where it cannot be read."""
    try:
        return decode_text(read_bytes(path, RPC_FILE))
    except BarpcError:
        return ""


def shadows(image: Path | str) -> list[Sidecar]:
    """Return the files beside an image that some tool reads instead of the RPC in the image itself.

    A VRT answers for itself in GDAL; what is beside a TIFF goes before its tag. A ``.geom`` is what OTB and CARS are
    given. GDAL's own ``.aux.xml`` counts where the image has no RPC.
    """
    image = location(image)
    driver = _image_driver(image)
    vrt = driver == "VRT"
    own = vrt or _own_rpc(image, driver) is not None
    found = (s for s in sidecars(image) if s.kind != "strip")  # which no tool reads for one tile
    return [s for s in found if s.kind == "geom" or (s.before_tag and not vrt) or not own]


def hidden_by(paths: Iterable[Path]) -> Iterator[tuple[Path, Path, RPC]]:
    """Yield images whose RPC some tool would not see if files were written: the file, the image, its RPC."""
    wanted: dict[Path, dict[str, Path]] = {}
    for path in paths:
        wanted.setdefault(path.parent, {})[path.name.lower()] = path
    for folder, files in wanted.items():
        for image in sorted(folder.iterdir()) if folder.is_dir() else ():
            beside = (files.get(name.lower()) for kind, name, _ in _sidecar_names(image.name) if kind != "strip")
            found = next((path for path in beside if path is not None and path.name != image.name), None)
            if found is not None:
                with suppress(ImageError, RpcError):
                    identify(image)
                    yield found, image, read_rpc(image)


def read_rpc(path: str | os.PathLike[str], *, first_pixel: float | None = None, band: int = 1) -> RPC:
    """Read the RPC of an image or of an RPC file; `read_rpc_source` says where it came from, too.

    Parameters
    ----------
    path, first_pixel, band : as of `barpc.rpcio.read_rpc_source`

    Returns
    -------
    RPC

    Raises
    ------
    RpcFormatError, ImageError
        As of `barpc.rpcio.read_rpc_source`.

    Examples
    --------
    >>> barpc.read_rpc("data_samples/view_00.tif")
    RPC(lon 5.3962 to 5.4038, ...)
    """
    return read_rpc_source(path, first_pixel=first_pixel, band=band).rpc


def read_rpc_source(path: str | os.PathLike[str], *, first_pixel: float | None = None, band: int = 1) -> RpcSource:
    """Read the RPC of an image or of an RPC file, and where it came from.

    For an image: the vendor's file beside it, the RPC in a GeoTIFF or NITF, GDAL's ``.aux.xml``, OSSIM's ``.geom``,
    and what GDAL shows of a raster of another kind, in this order. Any other file is read by what its content is.

    Parameters
    ----------
    path : Path or str, an image or an RPC file
    first_pixel, band : as of `ReadOptions`

    Raises
    ------
    RpcFormatError
        A file that should hold an RPC and does not parse; never a silent fallback to another one.
    ImageError
        No such file, or an image without an RPC.
    """
    path = location(path)
    options = ReadOptions(first_pixel, band)
    head = read_head(path, IMAGE, 64)
    driver = _image_driver(path)
    text = encoding_of(head)[:6] == "utf-16" or b"\0" not in head  # no other text holds a zero byte near its start
    if not text or driver not in (None, *MOSAICS):
        return _image_source(path, driver, options)
    if driver == "VRT" and isinstance(path, Path):
        items = read_vrt(path).metadata.get("RPC")
        if items is None:
            return _image_source(path, driver, options)
        return RpcSource(rpc_from_domain(items, str(path), options), "gdal", path)
    data = read_bytes(path, RPC_FILE)
    if tiles := tiles_of(decode_text(data), path):
        width, height = (max(corners[i] for corners in tiles.values()) + 1 for i in (2, 3))
        found = _image_source(path, driver, options)
        return replace(found, notes=(f"a mosaic of {len(tiles)} tiles", *found.notes), size=(width, height))
    rpc, name = parse_rpc(data, str(path), options)
    return RpcSource(rpc, name, path)


def _image_driver(path: PathOrUrl) -> str | None:
    """Return the driver of an image; a VRT may begin with a byte order mark or blanks."""
    return driver_at(path, read_head(path, IMAGE, 64).removeprefix(b"\xef\xbb\xbf").lstrip())


def _image_source(path: PathOrUrl, driver: str | None, options: ReadOptions) -> RpcSource:
    found = sidecars(path)
    first = next((sidecar for sidecar in found if sidecar.before_tag), None)
    own: RPC | None = None
    try:
        own = _own_rpc(path, driver)
    except RpcError:
        if first is None:
            raise
    if first is None and own is None and found:
        first = found[0]
    shown = driver not in (None, *MOSAICS) and own is None and (first is None or driver not in _RPC_READERS)
    domain = _stated_domain(path, options, alone=first is None) if shown else None
    ignored = [s.path.name for s in found if s is not first]
    if first is not None:
        source = _sidecar_source(path, first, options)
        ignored = ["the image's own RPC"] * (own is not None or domain is not None) + ignored
    elif own is not None:
        source = RpcSource(own, "tag" if driver == "GTiff" else "nitf", path)
    elif domain is not None:
        source = RpcSource(domain, "domain", path)
    else:
        raise MissingRpcError(
            f"{path}: {'no RPC in the image and none' if driver else f'{unknown_kind(path)}, and no RPC'} beside it"
            f" (.RPB, _RPC.TXT, .XML, .geom and others){_with_gcps(path)}"
            + ("" if driver else "; write its coefficients as an _RPC.TXT")
        )
    return replace(source, notes=source.notes + ((f"not used: {', '.join(ignored)}",) if ignored else ()))


def _with_gcps(path: PathOrUrl) -> str:
    with suppress(ImageError), open_raster(path) as dataset:
        if count := len(dataset.gcps[0]):
            return f"; it has {count} GCPs: 'barpc fit' makes an RPC of them"
    return ""


_RPC_READERS = {"GTiff": read_tag, "NITF": read_nitf}  # GDAL takes these before some files beside the image


def _own_rpc(path: PathOrUrl, driver: str | None) -> RPC | None:
    return _RPC_READERS[driver](path) if driver in _RPC_READERS else None


def _stated_domain(path: PathOrUrl, options: ReadOptions, alone: bool) -> RPC | None:
    """Return the RPC that GDAL shows of an image; errors are those of the image where no other file has one."""
    if alone:
        return read_domain(path, options)
    with suppress(BarpcError):
        return read_domain(path, options)
    return None


def _sidecar_source(image: PathOrUrl, sidecar: Sidecar, options: ReadOptions) -> RpcSource:
    rpc, name = parse_rpc(read_bytes(sidecar.path, RPC_FILE), str(sidecar.path), options)
    origin = {"geom": _crop_origin, **_TILE_ORIGINS}.get(sidecar.kind)
    moved = origin(image, sidecar.path) if origin else None
    if moved is None:
        return RpcSource(rpc, name, sidecar.path)
    window, note = moved
    return RpcSource(rpc.window(*window), name, sidecar.path, (f"{note} applied",))


_RpcWindow = tuple[tuple[float, float, float, float], str] | None
"""Corner and steps of a window of the image that an RPC speaks of, and what it is; None for the whole."""


def _crop_origin(image: PathOrUrl, _path: PathOrUrl) -> _RpcWindow:
    """Return where a crop is by its geotransform without CRS: a ``.geom`` speaks of the full image."""
    with open_raster(image) as dataset:
        step_x, _, x, _, step_y, y = dataset.transform[:6]
        has_crs = earth_crs(dataset) is not None
    if has_crs or (abs(step_x), abs(step_y), x, y) == (1.0, 1.0, 0.0, 0.0):
        return None
    if step_x <= 0 or step_y == 0:
        raise RpcFormatError(f"{image}: a geotransform that is no crop origin (steps {step_x}, {step_y})")
    row = y if step_y > 0 else -y  # a negative row step: y = -row
    return (x, row, step_x, abs(step_y)), f"crop origin ({x:g}, {row:g}) of the geotransform"


def _tile_origin(image: PathOrUrl, path: PathOrUrl) -> _RpcWindow:
    """Return the origin of a tile of a DIMAP product, whose RPC is the whole image's: by ``DIM_*.XML``."""
    tile = re.search(r"_R(\d+)C(\d+)$", image.stem.upper())
    if tile is None or tile.groups() == ("1", "1"):
        return None
    product = path.name[4:]
    dim = _file_beside(image, f"DIM_{product}") or _file_beside(path, f"DIM_{product}")
    text = decode_text(read_bytes(dim, RPC_FILE)) if dim else ""
    width, height = (re.search(rf"<NTILES_SIZE\b[^<>]*\b{key}=\"(\d{{1,9}})\"", text) for key in ("ncols", "nrows"))
    if width is None or height is None:
        raise RpcFormatError(f"{path}: the tile size of {image.name} is unknown (no DIM_{product} with NTILES_SIZE)")
    row, col = (int(index) - 1 for index in tile.groups())
    x, y = col * int(width.group(1)), row * int(height.group(1))
    return (x, y, 1.0, 1.0), f"tile origin ({x}, {y})"


# --- tiles ------------------------------------------------------------------------------------------------

_TILE_NAME = re.compile(r"_R(\d{1,4})C(\d{1,4})(?=[-_]|$)", re.IGNORECASE)


def _strip_name(stem: str) -> str:
    """Return the name of the strip of a tile, ``X`` of ``X_R1C2``; empty for other names."""
    found = _TILE_NAME.search(stem)
    return stem[: found.start()] + stem[found.end() :] if found else ""


def _file_beside(file: PathOrUrl, name: str) -> PathOrUrl | None:
    """Return the file of a name, whatever its case, beside another one; None without one."""
    present = files_of(file.parent) if isinstance(file, Path) else beside(file, [name])
    found = present.get(name.lower())
    return None if found is None else file.parent / found


def _strip_origin(image: PathOrUrl, path: PathOrUrl) -> _RpcWindow:
    """Return the origin of a tile in the strip whose RPC `path` is: by the ``.TIL`` beside either."""
    name, place = f"{_strip_name(image.stem)}.TIL", _TILE_NAME.search(image.stem)
    til = _file_beside(image, name) or _file_beside(path, name)
    if til is None:
        if place and [int(index) for index in place.groups()] == [1, 1]:
            return None
        raise RpcFormatError(
            f"{path}: the RPC of a strip, and where its tile {image.name} lies is not known: {name} is missing"
        )
    corners = tiles_of(decode_text(read_bytes(til, RPC_FILE)), til).get(image.name.lower())
    with open_raster(image) as dataset:
        size = dataset.width, dataset.height
    if corners is None or size != (corners[2] - corners[0] + 1, corners[3] - corners[1] + 1):
        raise RpcFormatError(
            f"{til}: lists no tile {image.name} of {size[0]} x {size[1]} px, so its place is not known"
        )
    left, top = corners[:2]
    return ((left, top, 1.0, 1.0), f"tile origin ({left}, {top})") if left or top else None


def at_tile(image: PathOrUrl, path: PathOrUrl, rpc: RPC) -> tuple[RPC, str] | None:
    """Return the RPC of a tile and a remark on the shift, where the file `path`, given for it, has the whole image's.

    The whole image's file is called so, or equal to the one beside the tile. None of an image that is no tile.
    """
    strip = _strip_name(image.stem)
    if not strip or path.name.lower().startswith(image.stem.lower()):
        return None
    kinds = {name.lower(): kind for kind, name, _ in _sidecar_names(image.name) if kind in _TILE_ORIGINS}
    kind = kinds.get(path.name.lower())
    for sidecar in (s for s in sidecars(image) if s.kind in _TILE_ORIGINS and kind is None):
        with suppress(BarpcError):
            kind = sidecar.kind if parse_rpc(read_bytes(sidecar.path, RPC_FILE), "")[0] == rpc else None
    if kind is not None:
        moved = _TILE_ORIGINS[kind](image, path)
        return (rpc.window(*moved[0]), f"{moved[1]} applied") if moved else None
    listed = any(_file_beside(image, f"{strip}{end}") for end in (".TIL", ".IMD"))
    return (rpc, f"taken as the RPC of this tile alone, not of its strip {strip}") if listed else None


_TILE_ORIGINS = {"dimap": _tile_origin, "strip": _strip_origin}
"""Kind of a file beside a tile whose RPC is that of the whole image -> where the tile lies in it."""
