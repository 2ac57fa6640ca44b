"""Texts of reference systems: what PROJ would open with them is never opened, whatever file they are in."""

from __future__ import annotations

import ctypes
import json
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import pyproj
import pytest
import rasterio
from pyproj.exceptions import CRSError
from rasterio.crs import CRS

from barpc.base.errors import BarpcError, ImageError, InputError
from barpc.pointio.gcps import ControlReference, read_gcps
from barpc.rasters.crs import crs_of, plain_crs, refuse_opening_crs
from barpc.rasters.dem import HeightGrid
from barpc.rasters.raster import map_crs, open_raster
from tests.lanes import rest_slow

MIDDLE = np.array([3.0, 45.0, 0.0])


_LIBC = ctypes.CDLL(None, use_errno=True)
_IN_OPEN = 0x20


class Canary:
    """A file, and whether anybody opened it, as the kernel tells (inotify)."""

    def __init__(self, path: Path) -> None:
        path.write_text("<1> +proj=longlat +ellps=WGS84 +no_defs <>\n")
        self.path, self._events = path, _LIBC.inotify_init1(os.O_NONBLOCK)
        assert _LIBC.inotify_add_watch(self._events, os.fsencode(path), _IN_OPEN) > 0

    @property
    def opened(self) -> bool:
        try:
            return bool(os.read(self._events, 4096))
        except BlockingIOError:
            return False

    def close(self) -> None:
        os.close(self._events)


@pytest.fixture
def canary(tmp_path: Path) -> Iterator[Canary]:
    made = Canary(tmp_path / "grid.gsb")
    yield made
    made.close()


@pytest.mark.filterwarnings("ignore:'.init")
def test_the_canary_sings(canary: Canary) -> None:
    assert not canary.opened
    pyproj.CRS.from_user_input(f"+init={canary.path}:1")
    assert canary.opened


def utm(extension: str, of_projection: str = "") -> str:
    return (
        f'PROJCS["m",GEOGCS["g",DATUM["d",SPHEROID["Bessel",6377397.155,299.1528128]{extension}],PRIMEM["Greenwich",0],'
        'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],'
        'PARAMETER["central_meridian",3],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
        f'PARAMETER["false_northing",0],UNIT["metre",1]{of_projection}]'
    )


_GEOGRAPHIC = (
    'GEOGCRS["g",DATUM["d",ELLIPSOID["Bessel",6377397.155,299.1528128]],CS[ellipsoidal,2],AXIS["lat",north],'
    'AXIS["lon",east],ANGLEUNIT["degree",0.0174532925199433]]'
)
_BOUND = (
    f'BOUNDCRS[SOURCECRS[{_GEOGRAPHIC}],TARGETCRS[{_GEOGRAPHIC}],ABRIDGEDTRANSFORMATION["t",METHOD["NTv2",'
    'ID["EPSG",9615]],PARAMETERFILE["Latitude and longitude difference file","%s"]]]'
)
_EXTENDED = utm("", ',EXTENSION["PROJ4","+proj=utm +zone=31 +ellps=bessel +nadgrids=%s +units=m +no_defs +wktext"]')
_METHOD = (
    f'PROJCRS["m",BASE{_GEOGRAPHIC},CONVERSION["c",METHOD["PROJ pipeline step proj=hgridshift grids=%s"]],'
    'CS[Cartesian,2],AXIS["e",east],AXIS["n",north],LENGTHUNIT["metre",1]]'
)  # fmt: skip
_HEIGHTS = (
    f'COMPOUNDCRS["c",{_GEOGRAPHIC},VERTCRS["v",VDATUM["v"],CS[vertical,1],AXIS["up",up],LENGTHUNIT["metre",1],'
    'GEOIDMODEL["PROJ %s"]]]'
)

OPENING = {
    "grid": "+proj=utm +zone=31 +ellps=bessel +nadgrids=%s +units=m +no_defs",
    "wkt of proj": _EXTENDED,
    "wkt with a grid": utm(',EXTENSION["PROJ4_GRIDS","%s"]'),
    "file of definitions": "+init=%s:1",
    "several grids": "+proj=utm +zone=31 +ellps=bessel +nadgrids=@null,%s",
    "geoid": "+proj=utm +zone=31 +datum=WGS84 +geoidgrids=%s +vunits=m",
    "definitions without a sign": "init=%s:1",
    "pipeline": "+proj=pipeline +step +proj=hgridshift +grids=%s",
    "title first": "+title=map +proj=utm +zone=31 +nadgrids=%s",
    "bound": _BOUND,
    "bound, round brackets": _BOUND.replace("[", "(").replace("]", ")"),
    "lower case": utm(',extension ["proj4_grids" , "%s"]'),
    "other quotation marks": utm(",EXTENSION[“PROJ4_GRIDS”,“%s”]"),
    "method": _METHOD,
    "geoid model": _HEIGHTS,
    "projjson": json.dumps({"type": "BoundCRS", "source_crs": {}, "parameters": [{"value": "%s"}]}),
    "path": "%s",
    "url": "http://127.0.0.1:9/crs%s",
    "file address": "file://%s",
    "gdal's folders": "/vsicurl/http://127.0.0.1:9%s",
}
"""Texts that make PROJ or GDAL open the path in place of %s, or look there."""

_UTM_31 = pyproj.CRS("EPSG:32631")
PLAIN = {
    **dict.fromkeys(
        ("EPSG:32631", "epsg:32631", "urn:ogc:def:crs:EPSG::32631", "WGS 84 / UTM zone 31N",
         "http://www.opengis.net/def/crs/EPSG/0/32631", "+proj=utm +zone=31 +datum=WGS84 +no_defs",
         "+proj=utm +zone=31 +ellps=WGS84 +units=m +type=crs"), 32631,
    ),
    **{_UTM_31.to_wkt(version): 32631 for version in ("WKT1_ESRI", "WKT1_GDAL", "WKT2_2015", "WKT2_2019")},
    pyproj.CRS("EPSG:3857").to_wkt("WKT1_GDAL"): 3857,  # nadgrids=@null
    "OGC:CRS84": None, "IGNF:LAMB93": None, "EPSG:26910+5703": None, "NAD83(2011) / UTM zone 10N": 6339,
    utm(",TOWGS84[598.1,73.7,418.2,0.202,0.045,-2.455,6.7]"): None,
    "+proj=lcc +lat_1=49 +lat_2=44 +lat_0=46.5 +lon_0=3 +x_0=700000 +y_0=6600000 +ellps=GRS80 +towgs84=0,0,0 +units=m":
        None,
}  # fmt: skip


def gcps(name: str, text: str) -> Callable[[Path, str], Path]:
    """A file of ground control with a reference system in place of %s."""

    def read(folder: Path, crs: str) -> Path:
        path = folder / name
        path.write_text(text % (crs.replace('"', '""') if '"%s"' in text else crs), encoding="utf-8")
        read_gcps(path, ["g"])
        return path

    return read


def placed(folder: Path, crs: str) -> Path:
    path = folder / "g.csv"
    path.write_text("id,east,north,col,row\np,500000,4800000,1,2\n")
    read_gcps(path, ["g"], ControlReference(crs))
    return path


def of_geojson(folder: Path, crs: str) -> Path:
    path = folder / "g.geojson"
    point = {"type": "Point", "coordinates": [500000.0, 4800000.0]}
    feature = {"type": "Feature", "geometry": point, "properties": {"col": 1, "row": 2}}
    named = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": named, "features": [feature]}))
    read_gcps(path, ["g"])
    return path


def of_a_dem(folder: Path, crs: str) -> Path:
    raster(folder / "a.tif", None)
    path = folder / "dem.vrt"
    path.write_text(
        f'<VRTDataset rasterXSize="4" rasterYSize="4"><SRS>{escape(crs)}</SRS><GeoTransform>5e5,1,0,5e6,0,-1'
        '</GeoTransform><VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="1">'
        "a.tif</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>",
        encoding="utf-8",
    )
    HeightGrid.open(path).sample(3.0, 45.0)
    return path


def of_a_map(folder: Path, crs: str) -> Path:
    map_crs(crs, MIDDLE)
    return Path("--crs")


CARRIERS: dict[str, Callable[[Path, str], Path]] = {
    "comment": gcps("g.csv", "# CRS: %s\nid,east,north,col,row\np,500000,4800000,1,2\n"),
    "--gcp-crs": placed, "odm": gcps("g.txt", "%s\n500000 4800000 1 2 3 g.tif\n"),
    "geojson": of_geojson, "vrt": of_a_dem,
    "column": gcps("g.csv", 'id,east,north,col,row,crs\np,500000,4800000,1,2,"%s"\n'), "--crs": of_a_map,
}  # fmt: skip


def raster(path: Path, crs: CRS | None, **how: str) -> None:
    """A raster of 4 x 4 px; GDAL opens the grid of a reference system when it is written, too."""
    what = {"width": 4, "height": 4, "count": 1, "dtype": "float32", "crs": crs}
    with rasterio.open(path, "w", "GTiff", **what, transform=rasterio.Affine(1, 0, 5e5, 0, -1, 5e6), **how) as file:
        file.write(np.ones((1, 4, 4), np.float32))


CASES = [
    pytest.param(carrier, name, id=f"{carrier}: {name}", marks=() if n < 3 or m == 0 else pytest.mark.nightly)
    for m, carrier in enumerate(CARRIERS)
    for n, name in enumerate(OPENING)
]


@pytest.mark.parametrize(("carrier", "name"), CASES)
def test_what_a_reference_system_points_at_is_not_opened(
    carrier: str, name: str, canary: Canary, tmp_path: Path
) -> None:
    text = OPENING[name].replace("%s", str(canary.path))
    try:
        CARRIERS[carrier](tmp_path, text)
    except BarpcError as error:
        said = str(error)
        assert said.isprintable()
        assert said.startswith(str(tmp_path)) or "crs" in said[:60]
    else:
        assert carrier == "odm"  # which takes nothing but a projection for one: +init is no header
    assert not canary.opened


@pytest.mark.parametrize("name", OPENING)
def test_each_is_refused_by_one_line_that_says_what_to_give(name: str) -> None:
    with pytest.raises(InputError, match=r"^a\.csv: .* is not read as a reference system \(.*\); give its code"):
        plain_crs(OPENING[name].replace("%s", "/a/grid"), "a.csv")


@pytest.mark.parametrize("text", PLAIN)
def test_codes_names_wkt_and_plain_parameters_are_read(text: str) -> None:
    found = crs_of(text, "a.csv")
    assert found.is_geographic or found.is_projected or found.is_compound
    if PLAIN[text] is not None:
        assert found.to_epsg(20) == PLAIN[text]


@pytest.mark.parametrize(
    "text", ["EPSG:999999", "nonsense", 'PROJCS["m",GEOGCS["g"', 'GEOGCS["g', "x" * 60_000, "", "a\0b"]
)
def test_what_is_no_reference_system_is_said(text: str) -> None:
    with pytest.raises(InputError, match=r"^a\.csv: .*reference system"):
        crs_of(text, "a.csv")


@pytest.mark.parametrize("count", rest_slow([12, 1500], mark=pytest.mark.nightly))
@pytest.mark.parametrize("version", ["WKT1_ESRI", "WKT1_GDAL", "WKT2_2019"])
def test_what_proj_writes_of_its_own_systems_is_plain(version: str, count: int) -> None:
    rng = np.random.default_rng(count)
    with closing(sqlite3.connect(Path(pyproj.datadir.get_data_dir()) / "proj.db")) as known:
        rows = known.execute("select auth_name, code from crs_view where deprecated = 0 order by 1, 2").fetchall()
    seen = 0
    for authority, code in rng.permutation(rows)[:count]:
        with suppress(CRSError):  # not all can be said in the older ones
            wkt = pyproj.CRS.from_authority(authority, code).to_wkt(version)
            assert plain_crs(wkt, "a") == wkt
            seen += 1
    assert seen > count / 3


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("order", ["LITTLE", "BIG"])
@pytest.mark.parametrize("bigtiff", ["NO", "YES"])
def test_gdal_is_not_shown_a_geotiff_whose_reference_system_opens_a_grid(
    tmp_path: Path, canary: Canary, order: str, bigtiff: str
) -> None:
    path = tmp_path / "dem.tif"
    crs = CRS.from_string(f"+proj=utm +zone=31 +ellps=bessel +nadgrids={canary.path} +units=m")
    raster(path, crs, GEOTIFF_KEYS_FLAVOR="ESRI_PE", ENDIANNESS=order, BIGTIFF=bigtiff)
    while canary.opened:  # when it was written
        pass
    with pytest.raises(ImageError, match=r"dem\.tif: .*PROJ4_GRIDS.*; give it its code"), open_raster(path):
        pass
    assert not canary.opened


@pytest.mark.parametrize("crs", ["EPSG:32631", "EPSG:3857", "EPSG:2154"])
def test_a_geotiff_of_esri_s_is_opened(tmp_path: Path, crs: str) -> None:
    raster(tmp_path / "a.tif", CRS.from_string(crs), GEOTIFF_KEYS_FLAVOR="ESRI_PE")
    with open_raster(tmp_path / "a.tif") as dataset:
        assert dataset.crs.is_projected


@pytest.mark.filterwarnings("ignore")
def test_the_same_text_in_a_jpeg_2000_is_found(tmp_path: Path) -> None:
    raster(tmp_path / "a.tif", CRS.from_string("+proj=utm +zone=31 +ellps=bessel +nadgrids=/no/grid +units=m"),
           GEOTIFF_KEYS_FLAVOR="ESRI_PE")  # fmt: skip
    tiff = (tmp_path / "a.tif").read_bytes()
    box = bytes.fromhex("b14bf8bd083d4b43a5ae8cd7d5a6ce03") + tiff
    start = b"\0\0\0\x0cjP  \r\n\x87\n"
    path = tmp_path / "a.jp2"
    for head in (len(box) + 8).to_bytes(4) + b"uuid", b"\0\0\0\1uuid" + (len(box) + 16).to_bytes(8), b"\0\0\0\0uuid":
        path.write_bytes(start + head + box)
        with pytest.raises(ImageError, match="PROJ4_GRIDS"):
            refuse_opening_crs(path, "JP2OpenJPEG")


@pytest.mark.parametrize("cut", range(0, 64, 7))
def test_a_geotiff_that_ends_early_is_gdal_s_to_refuse(tmp_path: Path, cut: int) -> None:
    raster(tmp_path / "a.tif", CRS.from_string("EPSG:32631"))
    path = tmp_path / "b.tif"
    path.write_bytes((tmp_path / "a.tif").read_bytes()[: 8 + cut])
    refuse_opening_crs(path, "GTiff")
    with pytest.raises(ImageError, match=r"b\.tif: is cut off "), open_raster(path):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grid", "file of definitions"])
def test_a_pipe_in_a_gcp_file_does_not_hold_up_adjust(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    text = OPENING[name].replace("%s", str(tmp_path / "pipe"))
    (tmp_path / "g.csv").write_text(f"# CRS: {text}\nid,east,north,col,row,image\np,500000,4800000,1,2,view_00.tif\n")
    images = sorted(Path("data_samples").glob("view_0*.tif"))
    words = ["-m", "barpc", "adjust", *images, "-o", tmp_path / "out", "--gcp", tmp_path / "g.csv"]
    found = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, timeout=120)
    assert found.returncode == 1
    assert "g.csv: CSV, its reference system: '+" in found.stderr
    assert "Traceback" not in found.stderr
