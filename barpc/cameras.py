"""The one door through which cameras come in: an image, an RPC file, a radar product, a grid of ground points.

`OPENERS` is the table of kinds. A file may be given with choices behind commas: ``product.SAFE,swath=iw1,pol=vv``,
``image.tif,camera=rpcs/image.RPB``, ``METADATA.XML,band=2,size=1000:900``, ``image.tif,model=physical``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from barpc.base.errors import ImageError, InputError, MissingRpcError, RpcError
from barpc.base.geodesy import EVERYWHERE as EVERYWHERE
from barpc.base.manifest import LAST
from barpc.base.remote import PathOrUrl, is_url, located, location
from barpc.base.safe_io import IMAGE, read_head
from barpc.rasters.raster import GRID_TAG, driver_at, driver_of, earth_crs, open_raster
from barpc.rpcio import read_rpc_source
from barpc.rpcio.formats import SIGN
from barpc.rpcio.plausible import RasterFrame, corners_off, doubts_of
from barpc.rpcio.sources import at_tile, metadata_beside, only_physical, scene_beside, stated_in_xml
from barpc.scene import Camera, View
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC, altitude_range

if TYPE_CHECKING:
    from barpc.pointio.correspondences import Correspondences

ChoiceReader = Callable[[str], Any]
ImageLike = Any
"""A path, perhaps with choices behind it (`open_camera`), an open rasterio dataset, a View or a Camera."""


@dataclass(frozen=True)
class Opener:
    """One kind of camera files."""

    sniff: Callable[[Any, bytes, Mapping[str, Any]], bool]
    """(path, its first 4096 bytes - none of a folder -, choices) -> whether it is of this kind."""
    open: Callable[..., Camera]
    """(path, **choices) -> Camera."""
    choices: Mapping[str, ChoiceReader] = field(default_factory=dict)
    """What may be given behind the file, and how its text is read (ValueError or KeyError: not so)."""
    whole: bool = False
    """Whether it states the size of its image: of pixels of another size it is no camera."""


def open_camera(spec: ImageLike | SensorModel, **choices: Any) -> Camera:
    """Open a camera, whatever it is.

    Parameters
    ----------
    spec : path, open rasterio dataset, View, Camera or SensorModel
        A file or folder, perhaps with choices behind it, ``,name=value``; a file of this whole name goes first.
    **choices
        The same as values; they go before those in `spec`. For every kind: ``camera`` (the file with the camera of the
        image `spec`), ``size`` (width, height). RPC: ``first_pixel`` (the file's coordinate of the first pixel's
        centre), ``band``. Sentinel-1: those of `sentinel1.open_product`. Grid: ``altitudes`` of its layers.
        Physical model, where ``model`` is "physical": those of `linescan.read_linescan`, and ``altitudes`` (low, high).

    Returns
    -------
    Camera, with `model`, `size`, `alt_range`, `format` and `path`

    Raises
    ------
    InputError
        A choice that this kind of camera does not have, or no value of it.
    ImageError, RpcError
        No such file, none of the kinds, or a damaged one.

    Examples
    --------
    >>> camera = barpc.open_camera("data_samples/view_00.tif")
    >>> camera.format, camera.size, camera.alt_range
    ('tag', (1000, 1000), (-50.0, 550.0))
    """
    spec = file_of(spec)
    if isinstance(spec, (str, os.PathLike)):
        return open_split(*split_spec(os.fspath(spec)), **choices)
    if choices:
        raise InputError(f"{', '.join(choices)} given for a {type(spec).__name__}; they are choices for a file")
    if isinstance(spec, Camera):
        return spec
    if isinstance(spec, View):
        return Camera(spec.sensor, Path(spec.path or spec.name), "view", spec.size, spec.alt_range)
    if isinstance(spec, SensorModel):
        levels = altitude_range(spec) if isinstance(spec, RPC) else EVERYWHERE
        return Camera(spec, Path(type(spec).__name__), "model", getattr(spec, "size", None), levels)
    raise InputError(f"{spec!r} is no image: give a path, an open dataset, a View or a Camera")


def file_of(image: ImageLike) -> Any:
    """Return the path of an open dataset; anything else as it is. InputError for a dataset without a file."""
    name, mode = getattr(image, "name", None), getattr(image, "mode", None)
    if isinstance(image, (str, os.PathLike, View, Camera)) or not (hasattr(image, "crs") and isinstance(name, str)):
        return image
    if mode != "r" or not (is_url(name) or os.path.lexists(name)):
        raise InputError(f"{name}: a dataset without a file that can be read (mode {mode}); write it to disk first")
    return name


def open_split(path: PathOrUrl, texts: Mapping[str, str], **choices: Any) -> Camera:
    """Open the camera of a file with the choices behind its name (see `open_camera`, `split_spec`).

    `dataset`: the raster `path`, where it is open already.
    """
    if isinstance(path, Path) and (path / LAST).is_file():
        raise InputError(f"{path}: the folder of a finished run, with adjusted cameras: give one of its images")
    texts, dataset = dict(texts), choices.pop("dataset", None)
    tags = None if dataset is None else dataset.tags()
    size, holder = (choices.pop(key, texts.pop(key, None)) for key in ("size", "camera"))
    file = path if holder is None else location(holder)
    opener = _opener_of(file, {**texts, **choices}, tags if holder is None else None)
    read = {key: _parse_choice(opener.choices[key], key, text, file) for key, text in texts.items()}
    camera = opener.open(file, **{**read, **choices})
    if holder is not None:
        camera = _of_tile(camera, path)
    frame = None if dataset is None else _frame(dataset)
    if frame is not None:
        size = frame.size
    elif isinstance(size, str):
        size = _parse_choice(_parse_size, "size", size, file)
    elif size is None:  # of the image's own pixels; those of a grid are not the image's
        wanted = holder is not None or opener.whole or camera.size is None
        frame = _raster_frame(path) if wanted else None
        size = None if frame is None else frame.size
    if opener.whole and size not in (None, camera.size):
        raise InputError(f"{path}: is {size} px large, its physical model in {camera.path} of {camera.size}")
    return _with_doubts(camera if size is None else replace(camera, size=size), frame)


def checked_camera(camera: Camera, dataset: Any) -> Camera:
    """Return a camera with the doubts that the open raster of its image raises."""
    return _with_doubts(camera, _frame(dataset))


def _with_doubts(camera: Camera, frame: RasterFrame | None) -> Camera:
    if camera.size is None or not isinstance(camera.model, RPC):
        return camera
    return replace(camera, doubts=doubts_of(camera.model, camera.size, frame))


def _opener_of(file: PathOrUrl, given: Mapping[str, Any], tags: Mapping[str, str] | None) -> Opener:
    """Return the row of `OPENERS` for a file; InputError where it does not have a choice that is given."""
    head, known = b"" if file.is_dir() else read_head(file, IMAGE), {**given, "tags": tags}
    name, opener = next((n, o) for n, o in reversed(OPENERS.items()) if o.sniff(file, head, known))
    if strange := next((key for key in given if key not in opener.choices), None):
        possible = ", ".join(("camera", "size", *opener.choices))
        raise InputError(f"{file}: {strange} is no choice for the kind {name}; known are {possible}")
    return opener


def _of_tile(camera: Camera, image: PathOrUrl) -> Camera:
    """Return the camera of a tile, where its file holds that of the whole image."""
    tile = at_tile(image, camera.path, camera.model) if isinstance(camera.model, RPC) else None
    return replace(camera, model=tile[0], notes=(*camera.notes, tile[1]), size=None) if tile else camera


def split_spec(spec: str | Path, hosts: Sequence[str] = ()) -> tuple[PathOrUrl, dict[str, str]]:
    """Split a file from the choices given behind it, as texts; ImageError for a host that is not allowed."""
    name, texts = os.fspath(spec), dict[str, str]()
    known = {"camera", "size", *(key for opener in OPENERS.values() for key in opener.choices)}
    last = re.compile(rf"(.*),({'|'.join(sorted(known))})=(.*)", re.DOTALL)
    while not os.path.lexists(name) and (found := last.fullmatch(name)):
        name, key, text = found.groups()
        texts.setdefault(key, text)
    if "camera" in texts:
        texts["camera"] = os.fspath(located(texts["camera"], hosts))
    return located(name, hosts), texts


def read_points(spec: str | Path) -> tuple[Correspondences | None, tuple[int, int] | None]:
    """Return the points of a table, a localisation grid or an image that has GCPs and no RPC; None of a camera.

    And the size of the image, given behind the file or its own.
    """
    from barpc.pointio.correspondences import correspondence_kind, read_correspondences

    path, texts = split_spec(spec)
    if path.is_dir() or path.suffix.lower() == ".zip" or b"<adsHeader>" in read_head(path, IMAGE):
        return None, None
    altitudes = _parse_choice(_colon_numbers, "altitudes", texts["altitudes"], path) if "altitudes" in texts else None
    if set(texts) - {"size", "altitudes"}:
        return None, None
    size = _parse_choice(_parse_size, "size", texts["size"], path) if "size" in texts else None
    if correspondence_kind(path, altitudes) is None:
        points, own = _tagged(path)
        return points, size or own
    return read_correspondences(path, altitudes=altitudes), size


def _tagged(path: PathOrUrl) -> tuple[Correspondences | None, tuple[int, int] | None]:
    if driver_at(path) is None or (isinstance(path, Path) and scene_beside(path)):
        return None, None
    try:
        read_rpc_source(path)
    except MissingRpcError:
        from barpc.pointio.correspondences import read_gcp_grid

        return read_gcp_grid(path)
    except (ImageError, RpcError):
        pass  # it is said where the camera is opened
    return None, None


def _parse_choice(reader: ChoiceReader, key: str, text: str, file: PathOrUrl) -> Any:
    try:
        return reader(text)
    except (ValueError, KeyError) as error:
        raise InputError(f"{file}: {key}={text} cannot be read") from error


def _parse_size(text: str) -> tuple[int, int]:
    width, height = (int(part) for part in text.split(":"))
    if min(width, height) < 1:
        raise ValueError(text)
    return width, height


def _raster_frame(path: PathOrUrl) -> RasterFrame | None:
    try:
        with open_raster(path) as dataset:
            return _frame(dataset)
    except ImageError:
        return None


def _frame(dataset: Any) -> RasterFrame:
    return RasterFrame((int(dataset.width), int(dataset.height)), dataset.transform, earth_crs(dataset))


def _open_rpc(path: PathOrUrl, first_pixel: float | None = None, band: int = 1) -> Camera:
    source = read_rpc_source(path, first_pixel=first_pixel, band=band)
    size, notes = source.size, source.notes
    if source.path == path and source.format in ("xml", "dimap"):  # given alone: it speaks of its whole image
        size, physical = stated_in_xml(path)
        if physical:
            notes = (*notes, "it holds a physical camera model, too: FILE,model=physical")
    return Camera(source.rpc, source.path, source.format, size, altitude_range(source.rpc), notes)


def _is_sentinel1(path: PathOrUrl, head: bytes, _choices: Mapping[str, Any]) -> bool:
    """Return whether it is a product folder or zip, its manifest, or an annotation."""
    return path.is_dir() or path.suffix.lower() in (".safe", ".zip") or b"<adsHeader>" in head


def _is_terrasar(path: PathOrUrl, head: bytes, _choices: Mapping[str, Any]) -> bool:
    """Return whether it is a product folder, or its annotation."""
    if not (path.is_dir() and isinstance(path, Path)):
        return b"<level1Product" in head
    from barpc.sensor.terrasar import find_annotation

    return find_annotation(path) is not None


def _holds_sicd(path: PathOrUrl, head: bytes, _choices: Mapping[str, Any]) -> bool:
    """Return whether it is the XML of a SICD image, or a NITF that holds it."""
    if b"SICD" not in head and not head.startswith(b"NITF02.10"):
        return False
    from barpc.sensor.sicd import find_sicd, is_sicd

    return is_sicd(head) or (head.startswith(b"NITF02.10") and isinstance(path, Path) and find_sicd(path) is not None)


def _is_csm(_path: PathOrUrl, head: bytes, _choices: Mapping[str, Any]) -> bool:
    if b"USGS_ASTRO_" not in head and b'"m_' not in head:
        return False
    from barpc.sensor.csm import is_state

    return is_state(head)


def _open_radar(path: PathOrUrl, key: str, reader: str, **choices: Any) -> Camera:
    """Open a radar's own model by a reader, ``module:function``, that is imported when it is needed."""
    module, _, function = reader.partition(":")
    choices |= {"polarisation": choices.pop("pol")} if "pol" in choices else {}
    model = getattr(import_module(f"barpc.sensor.{module}"), function)(_on_disk(path, "a radar product"), **choices)
    return Camera(model, path, key, model.size, model.alt_range)


def _on_disk(path: PathOrUrl, what: str) -> Path:
    """Return a file of this machine; ImageError on another host, as such a camera lies in many files."""
    if not isinstance(path, Path):
        raise ImageError(f"{path}: {what} is read from disk only")
    return path


def _open_csm(path: PathOrUrl, altitudes: tuple[float, float] = EVERYWHERE) -> Camera:
    from barpc.sensor.csm import open_state

    model, size = open_state(_on_disk(path, "a camera's state"))
    return Camera(model, path, "csm", size, altitudes)


def _is_grid(path: PathOrUrl, head: bytes, choices: Mapping[str, Any]) -> bool:
    if driver_of(head) != "GTiff":
        return False
    if "altitudes" in choices:
        return True
    if (tags := choices.get("tags")) is None:
        with open_raster(path) as dataset:
            tags = dataset.tags()
    return GRID_TAG in tags


def _open_grid(path: PathOrUrl, altitudes: list[float] | None = None) -> Camera:
    from barpc.pointio.correspondences import read_grid
    from barpc.sensor.direct_grid import DirectGrid

    nodes = read_grid(path, altitudes)
    grid = DirectGrid.from_points(nodes.ground, nodes.image)
    size = (max(1, int(grid.cols[-1]) + 1), max(1, int(grid.rows[-1]) + 1))  # an image that begins at (0, 0)
    return Camera(grid, path, "grid", size, (float(grid.alts[0]), float(grid.alts[-1])))


def _open_correction(path: PathOrUrl) -> Camera:
    from barpc.rpcio.grids import read_correction
    from barpc.sensor.image_corrections import Displaced

    rpc, lacking = read_correction(path)
    size = int(lacking.cols[-1]) + 1, int(lacking.rows[-1]) + 1  # its nodes go from corner to corner of the image
    return Camera(Displaced(rpc, lacking), path, "correction", size, altitude_range(rpc))


def _colon_numbers(text: str) -> list[float]:
    return [float(part) for part in text.split(":")]


def _interval(text: str) -> tuple[float, float]:
    low, high = _colon_numbers(text)
    if not -1e4 <= low < high <= 1e5:
        raise ValueError(text)
    return low, high


def _is_physical(path: PathOrUrl, head: bytes, choices: Mapping[str, Any]) -> bool:
    """Return whether the physical model is asked for, or is all that an XML, or an image of a SPOT scene, has."""
    if "model" in choices or not isinstance(path, Path):
        return choices.get("model") == "physical"
    if driver_of(head) is None:
        return _has_vendor_root(head) is not None and only_physical(path)
    return scene_beside(path) is not None and not _has_rpc(path)


def _has_rpc(path: Path) -> bool:
    with suppress(MissingRpcError):
        read_rpc_source(path)
        return True
    return False


def _open_physical(
    path: PathOrUrl, model: str = "physical", altitudes: tuple[float, float] | None = None, **choices: Any
) -> Camera:
    from barpc.sensor.linescan import read_linescan

    path = _on_disk(path, f"a {model} model")
    file = path if driver_at(path) is None else metadata_beside(path)
    found = read_linescan(file, **choices)
    low, high = _stated_altitudes(file) if altitudes is None else altitudes
    said, doubts = ("", ()) if found.corners is None else corners_off(found.model, found.corners)
    return Camera(found.model, file, found.kind, found.size, (low, high), (said,) if said else (), doubts)


def _stated_altitudes(file: Path) -> tuple[float, float]:
    """Return the altitudes of the RPC delivered with a physical model; all ground on Earth where there is none."""
    for name in (file.name, f"RPC_{file.name[4:]}"):
        try:
            return altitude_range(read_rpc_source(file.parent / name).rpc)
        except (ImageError, RpcError):
            continue
    return EVERYWHERE


_has_vendor_root = re.compile(rb"<(\w+:)?(isd|Dimap_Document)\b").search
_YES_NO = {"yes": True, "no": False}.__getitem__

OPENERS: dict[str, Opener] = {
    "rpc": Opener(
        lambda _path, _head, _choices: True,
        _open_rpc,
        {"first_pixel": {"auto": None, "0": 0.0, "0.5": 0.5, "1": 1.0}.__getitem__, "band": int},
    ),
    "sicd": Opener(_holds_sicd, partial(_open_radar, key="sicd", reader="sicd:open_sicd")),
    "grid": Opener(_is_grid, _open_grid, {"altitudes": _colon_numbers}),
    "correction": Opener(
        lambda _path, head, _choices: driver_of(head) == "GTiff" and SIGN.encode() in head, _open_correction
    ),
    "physical": Opener(
        _is_physical,
        _open_physical,
        {
            "model": str,
            "band": str,
            "altitudes": _interval,
            "attitudes": str,
            **dict.fromkeys(("aberration", "refraction"), _YES_NO),
        },
        whole=True,
    ),
    "sentinel-1": Opener(
        _is_sentinel1,
        partial(_open_radar, key="sentinel-1", reader="sentinel1:open_product"),
        {
            **dict.fromkeys(("swath", "pol", "orbit"), str),
            "burst": int,
            "atmosphere": _YES_NO,
            "bistatic": {"annotated": "annotated", "full": "full"}.__getitem__,
        },
    ),
    "csm": Opener(_is_csm, _open_csm, {"altitudes": _interval}, whole=True),
    "terrasar-x": Opener(_is_terrasar, partial(_open_radar, key="terrasar-x", reader="terrasar:open_terrasar")),
}
"""Kind -> how it is told from others and opened. The last row that knows a file has it; the first takes any."""
