"""A valid file of every kind that barpc reads, its reader, and the damage that suits it."""

from __future__ import annotations

import io
import json
import shutil
import tempfile
import warnings
import zipfile
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache, partial
from pathlib import Path

import numpy as np
import rasterio

from barpc.ba import BlockPrior
from barpc.ba.constraints.incremental import apply_prior
from barpc.ba.parameters.priors import CameraPrior
from barpc.base.errors import RpcError
from barpc.base.frozen import from_arrays, load_npz, to_arrays
from barpc.base.options import read_options
from barpc.base.verb_options import ExportOptions
from barpc.cameras import open_camera
from barpc.cli.flags import image_paths
from barpc.cli.project import given_points
from barpc.cli.terminal import print_comparison
from barpc.export.targets import export_run
from barpc.pipeline.calibrations import read_calibration
from barpc.pipeline.inputs import read_pairs
from barpc.pointio.correspondences import read_correspondences
from barpc.pointio.gcps import read_gcps
from barpc.rasters.dem import Dem
from barpc.report.compare import compare_runs
from barpc.report.page import report_html
from barpc.report.runfiles import read_summary
from barpc.rpcio import FORMATS, read_rpc, write_rpc_copy
from barpc.rpcio.acquisition import read_acquisition
from barpc.rpcio.formats import SIGN
from barpc.rpcio.grids import read_correction
from barpc.rpcio.images import put_tag
from barpc.rpcio.text import ReadOptions, decode_text
from barpc.scene import View
from barpc.sensor import SensorModel
from barpc.sensor.direct_grid import DirectGrid
from barpc.sensor.linescan import read_linescan
from barpc.sensor.sentinel1 import open_product
from barpc.sensor.sicd import open_sicd
from barpc.sensor.terrasar import open_terrasar
from barpc.tie.pairing.area import read_area
from barpc.workspace import Workspace
from tests.pipeline.test_calibrate import written as calibration_of
from tests.pointio.stages import read_matches
from tests.pointio.test_foreign import binary, colmap
from tests.pointio.test_gcp_formats import SAME as GCP_FILES
from tests.pointio.test_gcp_formats import geopackage_of, shapefile_of
from tests.report.conftest import run_of_block, written
from tests.rpcio.conftest import dimap_v1, dimap_v2, dimap_v3, enmap, envi, make_rpc, write_image, yaml
from tests.sealing import seal
from tests.sensor import terrasar_files
from tests.sensor.linescan_files import Flight, dimap, isd
from tests.sensor.radar_documents import document, nitf
from tests.sensor.s1_product import Product
from tests.sensor.spot_files import Scene

from .ends import mutate_npz_ends
from .kinds import Sample, bytes_of
from .mutate import Mutate, mutate_header, mutate_json, mutate_npz, mutate_text, mutate_values, mutate_xml
from .used import USED

NAMES = ("left", "right")
TEXT, ARRAYS = (mutate_text,), (mutate_npz, mutate_npz_ends)


# --- RPC files --------------------------------------------------------------------------------------------


def _alos() -> str:
    offsets = ["006500", "03550", " 35.6812", " 139.7671", " 0500"]
    cells = [f"{f'{1 + i / 100:+.5f}E-{i % 8}':>12}" for i in range(80)]
    return "".join([*offsets, *offsets, *cells])


def _read_format(path: Path, kind: str) -> object:
    """As whoever is sent this file reads it, and past the sniffing."""
    FORMATS[kind].read(decode_text(path.read_bytes()), str(path), ReadOptions())
    return read_rpc(path)


def _pam() -> str:
    from tests.rpcio.conftest import rpc_domain

    return f"<PAMDataset>\n{rpc_domain(make_rpc())}\n</PAMDataset>\n"


TEXTS: dict[str, Callable[[], str]] = {
    row.name: partial(row.write, make_rpc()) for row in FORMATS.values() if row.write is not None
} | {
    "dimap": lambda: dimap_v2(make_rpc()),
    "dimap v1": lambda: dimap_v1(make_rpc()),
    "dimap v3": lambda: dimap_v3(make_rpc()),
    "enmap": lambda: enmap(make_rpc()),
    "yaml": lambda: yaml(make_rpc()),
    "envi": lambda: envi(make_rpc()),
    "alos": _alos,
    "gdal": _pam,
}
_XML = ("xml", "dimap", "enmap", "gdal")


def _rpc_sample(kind: str) -> Sample:
    row = kind.split(" ", maxsplit=1)[0]
    mutations = ((mutate_xml,) if row in _XML else (mutate_json,) if row == "json" else ()) + TEXT
    return Sample(f"scene.{row}", partial(_read_format, kind=row), lambda: TEXTS[kind]().encode(), mutations)


def _tiff(folder: Path) -> Path:
    write_rpc_copy(make_rpc(), write_image(folder / "a.tif", shape=(1, 2, 2)), folder / "b.tif")
    return folder / "b.tif"


def _nitf() -> bytes:
    from tests.rpcio.conftest import nitf_record

    return b"NITF02.10" + b" " * 100 + b"RPC00B01041" + nitf_record(make_rpc()).encode() + b" " * 50


# --- rasters ----------------------------------------------------------------------------------------------


def _raster(
    bands: np.ndarray, transform: rasterio.Affine, tags: dict[str, str] | None = None, **profile: object
) -> bytes:
    count, height, width = bands.shape
    shape = {"driver": "GTiff", "count": count, "height": height, "width": width, "dtype": bands.dtype.name}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.MemoryFile() as memory:
            with memory.open(**shape, transform=transform, **profile) as out:
                out.write(bands)
                out.update_tags(**(tags or {}))
            return memory.read()


PLACE = rasterio.Affine(0.01, 0, 5, 0, -0.01, 44)
BENT = (0.0, -1.0, 1e-320, 1e308, np.nan, np.inf, 0.01, 1.0)


def _mutate_transform(make: Callable[..., bytes]) -> Mutate:
    def mutate(_: bytes, rng: np.random.Generator) -> bytes:
        numbers = list(PLACE[:6])
        for _ in range(rng.integers(1, 4)):
            numbers[int(rng.integers(6))] = float(rng.choice(BENT))
        return make(rasterio.Affine(*numbers), rng)

    return mutate


def _dem(transform: rasterio.Affine = PLACE, rng: np.random.Generator | None = None) -> bytes:
    kind, crs = ("float32", "EPSG:4326") if rng is None else (
        str(rng.choice(["int16", "float32", "float64", "complex64", "uint8"])),
        rng.choice(["EPSG:4326", "EPSG:32631", "EPSG:4979", "EPSG:4978", ""]),
    )  # fmt: skip
    with np.errstate(all="ignore"):
        heights = np.full((1, 20, 20), 100.0).astype(kind)
    return _raster(heights, transform, **({"crs": str(crs)} if crs else {}))


def _localisation(transform: rasterio.Affine | None = None, rng: np.random.Generator | None = None) -> bytes:
    row, col = np.mgrid[:4, :4].astype(np.float64)
    bands = np.stack([f for alt in (0, 1) for f in (5 + 0.01 * col + 1e-3 * alt, 44 - 0.01 * row)])
    tags = {"ALTITUDE_B0": "0", "ALTITUDE_B2": "500"}
    if rng is not None:
        tags[str(rng.choice(list(tags)))] = str(rng.choice(["nan", "0", "x", "1e308", "-1", "9" * 400]))
        bands.flat[int(rng.integers(bands.size))] = rng.choice(BENT)
    return _raster(bands, transform or rasterio.Affine(100, 0, 0, 0, 100, 0), tags)


def _use_dem(path: Path) -> object:
    return Dem.open(path)([5.05, 5.051, -170.0, np.nan], [43.95, 43.951, 80.0, 44.0])


def _use_grid(path: Path) -> object:
    points = read_correspondences(path)
    try:
        return DirectGrid.from_points(points.ground, points.image).project(points.ground[:5])
    except RpcError:  # points that are no full grid are a table still
        return None


def _correction(transform: rasterio.Affine | None = None, rng: np.random.Generator | None = None) -> bytes:
    shift = np.zeros((2, 3, 4), np.float32 if rng is None else rng.choice(["float32", "complex64", "int16"]))
    tags = {"CORRECTION": SIGN}
    if rng is not None:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shift.flat[int(rng.integers(shift.size))] = np.nan_to_num(rng.choice(BENT)).astype(shift.dtype)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.tif"
        path.write_bytes(_raster(shift, transform or rasterio.Affine(100, 0, -50, 0, 90, -45), tags))
        put_tag(path, make_rpc())
        return path.read_bytes()


def _use_correction(path: Path) -> object:
    read_correction(path)
    camera = open_camera(path)
    return camera.model.localize(np.array([[1.0, 2.0]]), np.array([camera.altitude])) if camera.size else None


def _gtx() -> bytes:
    head = np.array([-90.0, -180.0, 10.0, 10.0], ">f8").tobytes() + np.array([19, 36], ">i4").tobytes()
    return head + np.full((19, 36), 50.0, ">f4").tobytes()


def _pgm() -> bytes:
    head = b"P5\n# Geoid file in PGM format\n# Offset -108\n# Scale 0.003\n# Origin 90N 0E\n36 19\n65535\n"
    return head + np.full((19, 36), 52_000, ">u2").tobytes()


# --- arrays -----------------------------------------------------------------------------------------------


def _npz(**arrays: object) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _prior() -> bytes:
    return _npz(
        names=np.array(NAMES), model="rotation", drift=0, params=np.zeros((2, 3)), information=np.eye(6),
        center=np.full((2, 3), 7e6),
    )  # fmt: skip


def _use_prior(path: Path) -> object:
    prior = BlockPrior.load(path)
    cameras = CameraPrior(np.zeros((2, 3)), np.ones((2, 3)))
    try:
        return apply_prior(prior, NAMES, "rotation", 0, cameras)
    except Exception as error:
        if "earlier block" in str(error):  # what does not go with the run, not with itself
            return None
        raise


def _use_record(path: Path) -> object:
    record = load_npz(path)
    try:
        return from_arrays(record)
    except ValueError:  # its documented class: the kept result is made again
        return None


# --- runs -------------------------------------------------------------------------------------------------


@cache
def _run() -> Path:
    """A finished run, made once a process."""
    folder = Path(tempfile.mkdtemp(prefix="barpc-fuzz-"))
    written(run_of_block(3, 90, gcps=True), folder / "run")
    return folder / "run"


def _beside_run(folder: Path) -> None:
    shutil.copytree(_run(), folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".barpc"))


def _folder_of(path: Path) -> Path:
    """The run's folder of a file in it, or in that of its tables."""
    return path.parent.parent if path.parent.name == "tables" else path.parent


def _compare(path: Path) -> object:
    seal(path.parent)
    with redirect_stdout(io.StringIO()):
        for pair in ((path.parent, _run()), (_run(), path.parent)):
            print_comparison(compare_runs(*pair))
    return None


def _use_state(path: Path) -> object:
    with Workspace(path.parent.parent, overwrite=True) as workspace:
        workspace.remove_stale()
    return None


def _in_state(folder: Path) -> None:
    (folder / ".barpc").mkdir()


def _run_sample(name: str, read: Callable[[Path], object], *mutations: Mutate, share: float = 1.0) -> Sample:
    return Sample(name, read, lambda: (_run() / name).read_bytes(), mutations, _beside_run, share)


def _report(path: Path) -> object:
    folder = _folder_of(path)
    return report_html(read_summary(folder), folder)


_NOON = ExportOptions(time=("2020-06-01T11:30:00",))


def _export(path: Path) -> object:
    seal(_folder_of(path))
    with tempfile.TemporaryDirectory() as folder:
        for target in ("satnerf", "cars", "stac", "points"):
            export_run(_folder_of(path), target, Path(folder) / target, _NOON)
    return None


# --- Sentinel-1 -------------------------------------------------------------------------------------------

_BURSTS = Product(num_bursts=2, lines_per_burst=60, burst_cycle=50, num_states=17)
_GROUND = Product(swath="IW", product_type="GRD", num_bursts=9, lines_per_burst=60)


@cache
def _annotation(product: Product) -> bytes:
    return product.xml()


def _safe() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"S1A.SAFE/annotation/{_BURSTS.name}", _annotation(_BURSTS))
    return file.getvalue()


def _shown(camera: SensorModel) -> object:
    return camera.project(camera.localize(np.array([[100.0, 20.0]]), np.array([100.0])))


def _use_product(path: Path, **options: object) -> object:
    return _shown(open_product(path, **options))


def _use_orbit(path: Path) -> object:
    return _use_product(path.parent / _BURSTS.name, orbit=path)


def _beside_orbit(folder: Path) -> None:
    (folder / _BURSTS.name).write_bytes(_annotation(_BURSTS))


def _use_sicd(path: Path) -> object:
    return _shown(open_sicd(path))


def _sicd() -> bytes:
    """With error statistics; without its namespace, of which a mutated tree would make a prefix that none looks for."""
    axes = "".join(f"<P{k}>{k}</P{k}>" for k in (1, 2, 3))
    stated = f"<Components><PosVelErr><Frame>RIC_ECI</Frame>{axes}</PosVelErr></Components>"
    text = document("INCA").replace("</SICD>", f"<ErrorStatistics>{stated}</ErrorStatistics></SICD>")
    return text.replace(' xmlns="urn:SICD:1.2.1"', "").encode()


def _sicd_nitf(folder: Path) -> Path:
    return nitf(document("PFA"), folder / "image.ntf")


def _use_terrasar(path: Path) -> object:
    return _shown(open_terrasar(path))


def _use_georef(path: Path) -> object:
    return _use_terrasar(path.parents[1] / terrasar_files.NAME)


@cache
def _terrasar() -> tuple[bytes, bytes]:
    product = terrasar_files.Terrasar()
    return product.main().encode(), product.georef().encode()


def _beside_georef(folder: Path) -> None:
    (folder / "ANNOTATION").mkdir()
    (folder / terrasar_files.NAME).write_bytes(_terrasar()[0])


def _beside_main(folder: Path) -> None:
    _beside_georef(folder)
    (folder / "ANNOTATION" / "GEOREF.xml").write_bytes(_terrasar()[1])


# --- physical models --------------------------------------------------------------------------------------

_FLIGHT = Flight(size=(200, 1500))


def _use_linescan(path: Path) -> object:
    return _shown(read_linescan(path).model)


# --- lists and tables -------------------------------------------------------------------------------------


def _views() -> list[View]:
    return [View(name, f"/images/{name}.tif", (100, 100), make_rpc(), (0.0, 100.0)) for name in NAMES]


GCPS = (
    b'{"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": {"type": "Point",'
    b' "coordinates": [5.4, 43.2, 120.5]}, "properties": {"ji": [10.5, 20.25], "filename": "left.tif", "id": "one",'
    b' "sigma_m": [1, 1, 2], "sigma_px": 0.3}}]}'
)
AREA = (
    b'{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry":'
    b' {"type": "MultiPolygon", "coordinates": [[[[5, 44], [6, 44], [6, 45], [5, 44]],'
    b" [[5.4, 44.1], [5.5, 44.1], [5.5, 44.2], [5.4, 44.1]]]]}},"
    b' {"type": "Feature", "properties": {}, "geometry": {"type": "GeometryCollection", "geometries":'
    b' [{"type": "Polygon", "coordinates": [[[179, 0], [-179, 0], [-179, 1], [179, 0]]]}]}}]}'
)
OPTIONS = (
    b'images = "none"\nrpc_formats = ["txt", "rpb"]\nkeep_going = true\ngcp = ["a.gcp"]\n'
    b'[tie]\nband = 2\nangles = [1, 40.5]\nmatcher = "guided"\n[adjust]\nmodel = "rotation"\nfixed = ["left"]\n'
    b"sigma_attitude = 3.0\n[fit]\ngrid = [12, 12, 7]\ntolerance = 1e-3\n"
)
ASP_GCPS = (
    b"# WGS84\n1 43.2 5.4 120.5 1 1 1 left.tif 10.5 20.25 0.5 0.5 right.tif 30 40 0.5 0.5\n"
    b"2, 43.3, 5.5, 99, 0.1, 0.1, 0.2, left, 5, 6, 1, 1\n"
)
CSV_GCPS = (
    b"id,Longitude [deg],lat,h,image,px,py,sigma_xy,sigma_z,sigma_px\n1,5.4,43.2,120.5,left.tif,10.5,20.25,1,2,0.5\n"
    b'1,5.4,43.2,120.5,"right.tif",30,40,1,2,0.5\n2,5.5,43.3,99,left,5,6,,,\n'
)


def _gcps(path: Path) -> object:
    return read_gcps(path, NAMES)


def _matches(path: Path) -> object:
    return read_matches(path, NAMES)


def _of(name: str, read: Callable[[Path], object], data: bytes, mutations: tuple[Mutate, ...] = TEXT) -> Sample:
    return Sample(name, read, lambda: data, mutations)


def _gcp_sample(name: str, text: str) -> Sample:
    return _of(name, _gcps, text.encode(), {"<": (mutate_xml, mutate_text), "{": (mutate_json,)}.get(text[0], TEXT))


MATCHES = b"image,col,row,track,sigma\nleft,1.5,2.5,0,0.5\nright,3,4,0,0.5\nleft,7,8,b,1\nright.tif,9,1e1,b,1\n"
TABLE_OF_MATCHES = {
    "names": np.array(NAMES),
    "view": np.array([0, 1]),
    "track": np.zeros(2, int),
    "xy": np.ones((2, 2)),
}
PAIR = {"keypoints0": np.eye(2), "keypoints1": 9 * np.eye(2), "matches": np.array([[0, 1], [1, 0]])}
POINTS = (
    b'{"type": "FeatureCollection", "features": [{"geometry": {"coordinates": [5.4, 43.2, 1]},'
    b' "properties": {"ji": [1, 2]}}]}'
)
LIGHT = b"<X><IMAGING_DATE>2013-04-17</IMAGING_DATE><SUN_ELEVATION>5e1</SUN_ELEVATION></X>"


def _read_layer(path: Path) -> object:
    """Points of a layer that is called so, or lies beside."""
    return read_gcps(path if path.suffix == ".gpkg" else path.with_suffix(".shp"), ["left"])


def _of_shapefile(end: str, *mutations: Mutate) -> Sample:
    data = bytes_of(lambda folder: shapefile_of(folder, rows=3).with_suffix(end))
    return Sample(f"left{end}", _read_layer, data, mutations, partial(shapefile_of, rows=3))


SAMPLES: dict[str, Sample] = {
    **{f"rpc {kind}": _rpc_sample(kind) for kind in TEXTS},
    "rpc tag": Sample("b.tif", read_rpc, bytes_of(_tiff), (mutate_header,)),
    "rpc nitf": Sample("b.ntf", read_rpc, cache(_nitf), TEXT),
    "options": _of("run.toml", read_options, OPTIONS),
    "gcps": _of("a.gcp", _gcps, ASP_GCPS),
    "gcps csv": _of("a.csv", _gcps, CSV_GCPS),
    "gcps json": _of("a.geojson", _gcps, GCPS, (mutate_json,)),
    **{f"gcps {kind}": _gcp_sample(*row) for kind, row in GCP_FILES.items()},
    "gcps geopackage": Sample("a.gpkg", _read_layer, geopackage_of, share=0.3),
    "gcps shp": _of_shapefile(".shp"),
    "gcps dbf": _of_shapefile(".dbf"),
    "gcps prj": _of_shapefile(".prj", mutate_text),
    "calibration": Sample(
        "a.cal", read_calibration, bytes_of(lambda folder: calibration_of(folder / "a.cal")), (mutate_json,), share=0.3
    ),
    "matches csv": _of("t.csv", _matches, MATCHES),
    "matches npz": Sample("t.npz", _matches, partial(_npz, **TABLE_OF_MATCHES), ARRAYS),
    "matches asp": _of("run-left__right.txt", _matches, b"2 2\n1 2 0 0\n3 4 0 0\n5 6 0 0\n7 8 0 0\n"),
    "matches asp binary": _of("run-left__right.match", _matches, binary(np.eye(2), 9 * np.eye(2), 2), (mutate_header,)),
    "matches colmap": Sample("t.db", lambda path: read_matches(path, ["a", "b"]), bytes_of(colmap), (mutate_header,)),
    "matches dictionary": Sample("left__right.npz", _matches, partial(_npz, **PAIR), ARRAYS),
    "points csv": _of("p.csv", read_correspondences, b"lon,lat,alt,col,row\n5.4,43.2,100,1,2\n5.5,43.3,101,3,4\n"),
    "points json": _of("p.json", read_correspondences, POINTS, (mutate_json,)),
    "points npz": Sample(
        "p.npz", read_correspondences, partial(_npz, ground=np.ones((3, 3)), image=np.ones((3, 2))), ARRAYS
    ),
    "points of a verb": _of(
        "p.txt",
        lambda path: given_points((), str(path), ("lon", "lat", "alt"), 0.0),
        b"lon,lat,alt\n5.4,43.2,100\n5.5,43.3\n",
    ),
    "pairs": _of(
        "pairs.txt", lambda path: read_pairs(path, _views()), b"# two\nleft right\n'left.tif' \"right.tif\"\n"
    ),
    "images": _of("list.txt", lambda path: image_paths((), str(path), keep_going=True), b"left.tif\n# x\nright.tif\n"),
    "metadata": _of("product.xml", lambda path: read_acquisition("image.tif", str(path)), LIGHT),
    "area": _of("aoi.geojson", read_area, AREA, (mutate_json,)),
    "dem": Sample("dem.tif", _use_dem, _dem, (_mutate_transform(_dem), mutate_header), share=0.2),
    "dem hgt": Sample("N43E005.hgt", _use_dem, cache(lambda: bytes(2 * 1201**2)), (), share=0.02),
    "geoid gtx": Sample("geoid.gtx", _use_dem, _gtx, (mutate_header,)),
    "geoid pgm": Sample("geoid.pgm", _use_dem, _pgm, (mutate_header,)),
    "grid": Sample("nodes.tif", _use_grid, _localisation, (_mutate_transform(_localisation), mutate_header), share=0.2),
    "correction": Sample(
        "a_correction.tif", _use_correction, _correction, (_mutate_transform(_correction), mutate_header), share=0.2
    ),
    "prior": Sample("block.npz", _use_prior, _prior, ARRAYS),
    "record": Sample(
        "kept.npz", _use_record, lambda: _npz(**to_arrays((make_rpc(), {"a": [1.5, None]}, np.arange(3)))), ARRAYS
    ),
    "summary": _run_sample("summary.json", _report, mutate_json, mutate_values, mutate_values, share=0.6),
    "comparison": _run_sample("summary.json", _compare, mutate_json, mutate_values, mutate_values, share=0.6),
    "exported": _run_sample("summary.json", _export, mutate_json, mutate_values, mutate_values, share=0.3),
    "exported residuals": _run_sample("tables/residuals.csv", _export, mutate_text, share=0.1),
    "observations": _run_sample("tables/observations.csv", _report, mutate_text, share=0.1),
    "residuals": _run_sample("tables/residuals.csv", _report, mutate_text, share=0.1),
    "footprints": _run_sample("tables/footprints.geojson", _report, mutate_json, mutate_values, share=0.2),
    "compared RPC": _run_sample("view_0000_RPC.TXT", _compare, mutate_text, share=0.1),
    "state": Sample(
        ".barpc/state.json",
        _use_state,
        lambda: json.dumps({"barpc": "0", "status": "running", "stages": [], "outputs": ["a.txt"]}).encode(),
        (mutate_json,),
        _in_state,
        share=0.2,
    ),
    "annotation": Sample(_BURSTS.name, _use_product, lambda: _annotation(_BURSTS), (mutate_xml,), share=0.2),
    "annotation grd": Sample(_GROUND.name, _use_product, lambda: _annotation(_GROUND), (mutate_xml,), share=0.2),
    "sicd": Sample("image.xml", _use_sicd, _sicd, (mutate_xml,), share=0.2),
    "sicd nitf": Sample("image.ntf", _use_sicd, bytes_of(_sicd_nitf), (), share=0.2),
    "terrasar": Sample(
        terrasar_files.NAME, _use_terrasar, lambda: _terrasar()[0], (mutate_xml,), _beside_main, share=0.2
    ),
    "georef": Sample(
        "ANNOTATION/GEOREF.xml", _use_georef, lambda: _terrasar()[1], (mutate_xml,), _beside_georef, share=0.2
    ),
    "isd": Sample("image.XML", _use_linescan, lambda: isd(_FLIGHT)[0].encode(), (mutate_xml,)),
    "dimap model": Sample("DIM_image.XML", _use_linescan, lambda: dimap(_FLIGHT)[0].encode(), (mutate_xml,)),
    "spot": Sample("METADATA.DIM", _use_linescan, lambda: Scene(mission=4).text().encode(), (mutate_xml,)),
    "product zip": Sample("S1A.zip", _use_product, _safe, (), share=0.2),
    "orbit": Sample("S1A.EOF", _use_orbit, _BURSTS.eof, (mutate_xml,), _beside_orbit, share=0.2),
    **USED,
}
"""Kind -> sample."""
