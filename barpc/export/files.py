"""Files for other tools, as bytes: Sat-NeRF, stereo pipelines, catalogues, tables of points, GDAL's commands."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from barpc.base.errors import InputError
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, metres_per_unit, polygon, wrap_longitude
from barpc.base.verb_options import ExportOptions
from barpc.export.light import lit, moment, require
from barpc.export.shots import Scene, Shot, pairs_of, relative_link
from barpc.report.records import json_form
from barpc.rpcio import WRITABLE
from barpc.sensor.geometry import footprint

FileContents = Mapping[str, bytes | Callable[[], bytes]]
"""Content of files by name, or what makes it when it is written."""

_COLLECTION = "collection.json"
_EXTENSIONS = {"proj": "projection/v2.0.0", "view": "view/v1.0.0", "processing": "processing/v1.2.0"}
"""STAC extensions by the prefix of their fields."""
_TYPES = {
    ".tif": "image/tiff; application=geotiff",
    ".vrt": "application/xml",
    ".xml": "application/xml",
    ".json": "application/json",
}
_COVARIANCE_ENTRIES = [(i, j) for i in range(3) for j in range(i, 3)]
_VARIANCES = tuple(f"var_{'enu'[i]}{'enu'[j]}" for i, j in _COVARIANCE_ENTRIES)


def as_json(value: Any) -> bytes:
    """Return a JSON text; what is not finite is null."""
    return (json.dumps(json_form(value), indent=1, ensure_ascii=False) + "\n").encode()


# --- Sat-NeRF ---------------------------------------------------------------------------------------------


def _record(scene: Scene, shot: Shot, img: str) -> dict[str, Any]:
    """Return the record of an image that Sat-NeRF and its relatives read."""
    low, high = scene.alt_range
    ring = footprint(shot.rpc, shot.size, scene.origin[2])
    middle, when = scene.middle(shot), moment(shot.light.time)
    assert when is not None
    top = shot.rpc.localize(shot.xy, np.full(len(shot.xy), high))
    depth = np.linalg.norm(ecef_from_ground(top) - ecef_from_ground(scene.points[shot.index]), axis=1)
    return {
        "img": img,
        "height": shot.size[1],
        "width": shot.size[0],
        "sun_elevation": shot.light.elevation,
        "sun_azimuth": shot.light.azimuth,
        "acquisition_date": f"{when:%Y%m%d%H%M%S}",  # as STDIDC in NITF has it, and its scripts parse
        "geojson": {**(polygon(ring) or {}), "center": [float(wrap_longitude(middle[0])), float(middle[1])]},
        "min_alt": low,
        "max_alt": high,
        "rpc": shot.rpc.to_rpcm_dict(),
        "keypoints": {"2d_coordinates": shot.xy, "pts3d_indices": shot.index, "depths": depth},
    }


def satnerf(scene: Scene, out: Path, _how: ExportOptions) -> FileContents:
    """Write ``<image>.json`` each, the points in ``pts3d.npy`` (ECEF), ``train.txt`` and ``test.txt``; EOGS reads them.

    UnknownTimeError for an image whose time of acquisition is unknown.
    """
    scene = lit(scene)
    rows = zip(scene.shots, scene.file_names(out), strict=True)
    files = {f"{shot.name}.json": as_json(_record(scene, shot, img)) for shot, img in rows}
    names = list(files)
    points = io.BytesIO()
    np.save(points, ecef_from_ground(scene.points), allow_pickle=False)
    # no end of line after the last
    lists = {"train.txt": "\n".join(names).encode(), "test.txt": names[-1].encode()}
    return {**files, **lists, "pts3d.npy": points.getvalue()}


# --- stereo pipelines -------------------------------------------------------------------------------------


def _image(shot: Shot, out: Path) -> str:
    """Return the image as a configuration in `out` names it: the run's VRT or copy where there is one."""
    return relative_link(shot.carrier or shot.file, out)


def _rpc_text(shot: Shot, name: str) -> bytes:
    write = WRITABLE[name].write
    assert write is not None
    return write(shot.rpc).encode()


def s2p(scene: Scene, out: Path, _how: ExportOptions) -> FileContents:
    """Write ``config.json``: the images, the first as reference, each with its corrected RPC."""
    images = [{"img": _image(shot, out), "rpc": shot.rpc.to_rpcm_dict()} for shot in scene.shots]
    return {"config.json": as_json({"out_dir": "s2p_out", "images": images, "full_img": True})}


def cars(scene: Scene, out: Path, _how: ExportOptions) -> FileContents:
    """Write ``inputs.yaml``, with the pairs whose angle shows heights, and a ``.geom`` an image."""
    sensors = {}
    for shot in scene.shots:
        camera = {"path": f"{shot.name}.geom", "model_type": "RPC"}
        sensors[shot.name] = {"image": _image(shot, out), "geomodel": camera}
    pairing = [list(pair) for pair in pairs_of(scene)]
    found = {"input": {"sensors": sensors, "pairing": pairing}, "output": {"directory": "cars_out"}}
    files = {f"{shot.name}.geom": _rpc_text(shot, "geom") for shot in scene.shots}
    return {**files, "inputs.yaml": as_json(found)}  # (JSON is YAML)


def asp(scene: Scene, out: Path, _how: ExportOptions) -> FileContents:
    """Write ``<image>.xml`` each (in Maxar's form), and lists of images and cameras for its tools, run in `out`."""
    files = {f"{shot.name}.xml": _rpc_text(shot, "xml") for shot in scene.shots}
    lists = {"images.txt": [_image(shot, out) for shot in scene.shots], "cameras.txt": list(files)}
    return files | {name: ("\n".join(lines) + "\n").encode() for name, lines in lists.items()}


# --- catalogues and points --------------------------------------------------------------------------------


def stac(scene: Scene, out: Path, _how: ExportOptions) -> FileContents:
    """Write ``collection.json``, and ``<image>.json``: a STAC item of every image with its files in the run folder.

    UnknownTimeError for an image whose day of acquisition is unknown.
    """
    require([shot for shot in scene.shots if not shot.light.time], "day")
    items = {f"{shot.name}.json": _item(scene, shot, out) for shot in scene.shots}
    if _COLLECTION in items:
        raise InputError(f"an image is called {_COLLECTION[:-5]}, as the collection of its catalogue is: rename it")
    return {name: as_json(item) for name, item in ({_COLLECTION: _stac_collection(scene, items)} | items).items()}


def _stac_collection(scene: Scene, items: Mapping[str, Any]) -> dict[str, Any]:
    """Return the STAC collection of a run's items."""
    boxes = np.array([item["bbox"] for item in items.values()])
    west = wrap_longitude(boxes[:, 0], boxes[0, 0])
    east = west + np.mod(boxes[:, 2] - boxes[:, 0], 360.0)
    first, last = (float(wrap_longitude(lon)) for lon in (west.min(), east.max()))
    ends = [first, boxes[:, 1].min(), last, boxes[:, 3].max()]
    times = [[item["properties"].get(f"{end}_datetime", item["properties"]["datetime"]) for item in items.values()]
             for end in ("start", "end")]  # fmt: skip
    return {
        "type": "Collection",
        "stac_version": "1.1.0",
        "id": scene.folder.resolve().name or "barpc",
        "description": f"{len(items)} images with RPCs corrected by bundle adjustment (barpc {scene.summary.barpc})",
        "license": "other",
        "extent": {
            "spatial": {"bbox": [ends]},
            "temporal": {"interval": [[min(times[0]), max(times[1])]]},
        },
        "links": [
            {"rel": "root", "href": f"./{_COLLECTION}", "type": "application/json"},
            *({"rel": "item", "href": f"./{quote(name)}", "type": "application/geo+json"} for name in items),
        ],
    }


def _item(scene: Scene, shot: Shot, out: Path) -> dict[str, Any]:
    view = shot.entry
    ring = footprint(shot.rpc, shot.size, scene.origin[2])
    west, east = (float(wrap_longitude(lon)) for lon in (ring[:, 0].min(), ring[:, 0].max()))
    when: dict[str, Any] = {"datetime": shot.light.time}
    if moment(shot.light.time) is None:  # a day alone
        when = {"datetime": None, **{f"{end}_datetime": f"{shot.light.time}T{clock}Z"
                for end, clock in (("start", "00:00:00"), ("end", "23:59:59"))}}  # fmt: skip
    seen = {
        "gsd": view.gsd_m,
        "view:incidence_angle": view.incidence_deg,
        "view:azimuth": view.azimuth_deg,
        "view:sun_azimuth": shot.light.azimuth,
        "view:sun_elevation": shot.light.elevation,
    }
    properties = {
        **when,
        **{key: value for key, value in seen.items() if value is not None},
        "proj:code": None,
        "proj:shape": [shot.size[1], shot.size[0]],
        "processing:software": {"barpc": scene.summary.barpc},
        "rpc": shot.rpc.to_rpcm_dict(),
    }
    used = sorted({key.partition(":")[0] for key in properties} & _EXTENSIONS.keys())
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "stac_extensions": [f"https://stac-extensions.github.io/{_EXTENSIONS[one]}/schema.json" for one in used],
        "id": shot.name,
        "geometry": polygon(ring),
        "bbox": [west, float(ring[:, 1].min()), east, float(ring[:, 1].max())],
        "properties": properties,
        "collection": scene.folder.resolve().name or "barpc",
        "links": [
            {"rel": rel, "href": f"./{_COLLECTION}", "type": "application/json"}
            for rel in ("root", "parent", "collection")
        ],
        "assets": {name: _asset(shot.writer.folder / name, out) for name in shot.written}
        | {"image": {"href": relative_link(shot.file, out), "roles": ["source"]}},
    }


def _asset(path: Path, out: Path) -> dict[str, Any]:
    of_pixels = path.suffix.lower() in (".vrt", ".tif")
    kind = _TYPES.get(path.suffix.lower(), "text/plain")
    return {"href": relative_link(path, out), "type": kind, "roles": ["data" if of_pixels else "metadata"]}


def points(scene: Scene, _out: Path, _how: ExportOptions) -> FileContents:
    """Write ``points.csv`` and ``points.ply``: every tie point with the covariance of its place, east, north, up [m2].

    It is what the noise of the observations leaves with cameras as they are; what is common to all points, the place of
    the scene, is stated in the head of both.
    """
    covariance = _covariances(scene)
    sums = np.array([covariance[:, i, j] for i, j in _COVARIANCE_ENTRIES]).T
    place = scene.summary.scene
    sigma = "unknown" if place is None else ", ".join(f"{v:.4g}" for v in place.sigma_enu_m if v is not None)
    said = f"covariance [m2] of the intersection alone; noise {scene.noise:.4g} px;"
    said += f" the scene's own place east, north, up is known to [m]: {sigma}"
    lines = [f"# {said}", ",".join(("track", "lon", "lat", "alt", *_VARIANCES))]
    for track, place_of, row in zip(scene.tracks.tolist(), scene.points.tolist(), sums.tolist(), strict=True):
        lon, lat, alt = place_of
        cells = (f"{value:.6g}" if np.isfinite(value) else "" for value in row)
        lines.append(f"{track},{lon:.9f},{lat:.9f},{alt:.4f},{','.join(cells)}")
    east, north, up = scene.world(scene.points).T
    columns = {"x": east, "y": north, "z": up, "track": scene.tracks.astype(np.int32)}
    columns |= dict(zip(_VARIANCES, sums.T.astype(np.float32), strict=True))
    lon, lat, alt = scene.origin
    frame = f"x east, y north, z up [m] of lon {lon:.9f} lat {lat:.9f} alt {alt:.4f} (WGS84, ellipsoid)"
    return {"points.csv": ("\n".join(lines) + "\n").encode(), "points.ply": ply(columns, said, frame)}


def _covariances(scene: Scene) -> Array:
    """Return the covariance (P, 3, 3) of the points, east, north, up [m2]: the inverse of their normal matrices."""
    normal = np.zeros((len(scene.points), 3, 3))
    for shot in scene.shots:
        ground = scene.points[shot.index]
        rows = shot.rpc.project_jacobian(ground)[1] / metres_per_unit(ground)[:, None, :]
        rows = rows @ enu_basis(ground) @ enu_basis(scene.origin).T
        np.add.at(normal, shot.index, rows.swapaxes(1, 2) @ rows)
    normal[~np.isfinite(normal).all(axis=(1, 2))] = 0.0
    values, axes = np.linalg.eigh(normal)
    known = values[:, 0] > 1e-12 * values[:, 2]
    out = np.full_like(normal, np.nan)
    out[known] = scene.noise**2 * (axes[known] / values[known, None]) @ axes[known].swapaxes(1, 2)
    return out


_PLY = {"float64": "double", "float32": "float", "int32": "int", "uint8": "uchar"}


def ply(columns: Mapping[str, npt.NDArray[Any]], *comments: str) -> bytes:
    """Return points as a binary PLY: columns (n,) by their names, of the types of `_PLY`, and comments."""
    kinds = [(name, column.dtype) for name, column in columns.items()]
    records: Any = np.rec.fromarrays(list(columns.values()), dtype=kinds)
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    header.append(f"element vertex {len(records)}")
    header += [f"property {_PLY[column.dtype.name]} {name}" for name, column in columns.items()]
    rows: bytes = records.tobytes()
    return ("\n".join([*header, "end_header"]) + "\n").encode() + rows
