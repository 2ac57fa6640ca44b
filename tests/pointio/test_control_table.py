"""Control as people have it: one file of each kind, points and pixels all different, against the truth.

Truth is made by GDAL's transformations and by hand; no row is read back from what barpc writes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rasterio.warp import transform

from barpc.pointio.gcps import ControlReference, read_gcps
from tests.pointio.conftest import refused
from tests.pointio.test_gcp_formats import ALT, COL, LAT, LON, NO_ALTITUDE, ROW, SAME

VIEWS = ["left", "right.img", "IMG_2021-03 a"]
FOOT, US_FOOT = 0.3048, 1200 / 3937
DOS = "\r\n"
P = {"a": (5.4, 43.3, 240.5), "b": (5.4125, 43.2875, 101.25), "c": (5.3875, 43.3125, 330.0)}
"""Points: lon, lat, alt."""
SEEN = [("a", 0, 263.25, 889.75), ("a", 1, 12.5, 7.0), ("b", 0, 100.0, 200.5), ("c", 2, 55.5, 66.25)]
"""Point, view, col, row: (0, 0) is the centre of the first pixel."""
NAMED = ("left", "right.img", "IMG_2021-03 a")


@dataclass(frozen=True)
class Case:
    """A file, and what it holds."""

    text: str
    file: str = "control.csv"
    encoding: str = "utf-8"  # "utf-16": as Excel writes it, with its mark
    newline: str = "\n"
    frame: ControlReference | None = None
    points: dict[str, tuple[float, float, float]] | None = None  # other places than P
    seen: tuple[tuple[str, int, float, float], ...] | None = None  # others than SEEN
    tolerance: float = 1e-9  # deg: a tenth of a millimetre
    flat: bool = False  # no altitudes


def rows(template: str, places: dict[str, tuple[float, ...]] = P, names: tuple[str, ...] = NAMED, more: float = 0.0):
    """A line for each observation; {p} {x} {y} {z} {i} {c} {r} are its point, place, image, col and row."""
    return "".join(
        template.format(p=p, x=x, y=y, z=z, i=names[v], c=c + more, r=r + more) + "\n"
        for p, v, c, r in SEEN
        for x, y, z in (places[p],)
    )


def comma(text: str) -> str:
    """The same with decimal commas."""
    return text.replace(".", ",").replace("right,img", "right.img")


def moved(crs: str, places: dict[str, tuple[float, float, float]] = P) -> dict[str, tuple[float, float, float]]:
    """The places in map coordinates, x to the east, by GDAL."""
    found = transform("EPSG:4326", crs, *zip(*((x, y) for x, y, _ in places.values()), strict=True))
    return {p: (x, y, places[p][2]) for p, x, y in zip(places, *found, strict=True)}


def scaled(places: dict[str, tuple[float, float, float]], unit: float) -> dict[str, tuple[float, float, float]]:
    return {p: (x, y, z / unit) for p, (x, y, z) in places.items()}


def at(lon: float, lat: float) -> dict[str, tuple[float, float, float]]:
    """P, shifted to another part of the Earth."""
    return {p: (round(lon + x - 5.4, 9), round(lat + y - 43.3, 9), z) for p, (x, y, z) in P.items()}


def dms(value: float, letters: str, form: str) -> str:
    """Degrees, minutes and seconds of a value, by a form with {d} {m} {s} {h}."""
    total = round(abs(value) * 3600, 6)
    d, m, s = int(total // 3600), int(total % 3600 // 60), round(total % 60, 6)
    return form.format(d=d, m=m, s=f"{s:g}", h=letters[value < 0], mm=f"{total % 3600 / 60:.8f}")


def dms_rows(form: str, places: dict[str, tuple[float, float, float]]) -> str:
    texts = {p: (dms(x, "EW", form), dms(y, "NS", form), z) for p, (x, y, z) in places.items()}
    return rows("{p};{y};{x};{z};{i};{c};{r}", texts)  # type: ignore[arg-type]


def feature(p: str, view: int, c: float, r: float, place: list[float], **properties: object) -> dict[str, object]:
    named = {"name": p, "image": NAMED[view], "col": c, "row": r} | properties
    return {"type": "Feature", "properties": named, "geometry": {"type": "Point", "coordinates": place}}


def geojson(places: dict[str, tuple[float, ...]] = P, size: int = 3, **document: object) -> str:
    features = [feature(p, v, c, r, list(places[p][:size])) for p, v, c, r in SEEN]
    return json.dumps({"type": "FeatureCollection", **document, "features": features})


def of_urn(code: str) -> dict[str, object]:
    return {"type": "name", "properties": {"name": code}}


def micmac(places: dict[str, tuple[float, float, float]] = P) -> str:
    ground = "".join(
        f"<OneAppuisDAF><Pt>{x!r} {y!r} {z!r}</Pt><NamePt>{p}</NamePt><Incertitude>1 1 1</Incertitude></OneAppuisDAF>"
        for p, (x, y, z) in places.items()
    )
    image = "".join(
        f"<MesureAppuiFlottant1Im><NameIm>{name}</NameIm>"
        + "".join(
            f"<OneMesureAF1I><NamePt>{p}</NamePt><PtIm>{c} {r}</PtIm></OneMesureAF1I>" for p, v, c, r in SEEN if v == k
        )
        + "</MesureAppuiFlottant1Im>"
        for k, name in enumerate(NAMED)
    )
    image = f"<SetOfMesureAppuisFlottants>{image}</SetOfMesureAppuisFlottants>"
    return f"<?xml version='1.0'?>\n<!-- a b -->\n<Global>{ground}{image}</Global>"


UTM, SOUTH, WEST = moved("EPSG:32631"), at(174.7, -36.85), at(-122.4, 37.75)
ECEF = {
    p: (float(x), float(y), float(z))
    for p, x, y, z in zip(P, *transform("EPSG:4979", "EPSG:4978", *zip(*P.values(), strict=True)), strict=True)
}
LEFT = tuple(row for row in SEEN if row[1] == 0)
_QGIS = "".join(f"{P[p][0]},{P[p][1]},{c + 0.5},{-r - 0.5},1,0,0,0\n" for p, _, c, r in LEFT)
_ASP = "".join(
    f"{p}\t{y} {x}  {z} 1 1 1 " + " ".join(f"{NAMED[v]} {c} {r} 1 1" for q, v, c, r in SEEN if q == p and v < 2) + "\n"
    for p, (x, y, z) in P.items() if p != "c"
)  # fmt: skip
_HEAD = "name,lat,lon,h,image,col,row\n"
_CSV = "{p},{y},{x},{z},{i},{c},{r}"

CASES: dict[str, Case] = {
    # --- texts and cells
    "csv, latitude first": Case(_HEAD + rows(_CSV)),
    "csv, dos": Case(_HEAD + rows(_CSV), newline=DOS),
    "csv, old mac": Case(_HEAD + rows(_CSV), newline="\r"),
    "csv, byte order mark, comment at the end": Case(_HEAD + rows(_CSV) + "# the end\n", encoding="utf-8-sig"),
    "csv, utf-16, tabs": Case((_HEAD + rows(_CSV)).replace(",", "\t"), encoding="utf-16"),
    "csv, utf-16 of big ends": Case("\ufeff" + _HEAD + rows(_CSV), encoding="utf-16-be"),
    "csv, semicolons and decimal commas": Case(
        _HEAD.replace(",", ";") + comma(rows("{p};{y};{x};{z};{i};{c};{r}")), newline=DOS),
    "csv, tabs and decimal commas, utf-16": Case(
        _HEAD.replace(",", "\t") + comma(rows("{p}\t{y}\t{x}\t{z}\t{i}\t{c}\t{r}")), encoding="utf-16"),
    "csv, all quoted": Case(
        '"name","lat","lon","h","image","col","row"\n' + rows('"{p}","{y}","{x}","{z}","{i}","{c}","{r}"')),
    "csv, blanks in columns": Case(
        "name   lat      lon     h   image  col   row\n"
        + "".join(f"{p}    {P[p][1]}   {P[p][0]}  {P[p][2]}  {NAMED[v]}   {c}  {r}\n" for p, v, c, r in LEFT),
        seen=LEFT),
    "csv, columns of no meaning, blank lines, comments": Case(
        "# surveyed\n\nno remark,Lat [deg],Lon [deg],h (m),name,photo,Col,Row,operator\n"
        + rows("x,{y},{x},{z},{p},{i},{c},{r},me\n")),
    "csv, signs and exponents": Case(
        _HEAD + "".join(f"{p},+{P[p][1]},{P[p][0] / 10!r}E1,{P[p][2]},{NAMED[v]},{c}e0,{r}\n" for p, v, c, r in SEEN)),
    "csv, longitudes from 0 to 360": Case(
        _HEAD + rows(_CSV, {p: (x + 360, y, z) for p, (x, y, z) in WEST.items()}), points=WEST),
    # --- names of images
    "csv, with endings": Case(_HEAD + rows(_CSV, names=("left.tif", "right.img", "IMG_2021-03 a.JP2"))),
    "csv, without endings": Case(_HEAD + rows(_CSV, names=("left", "right", "IMG_2021-03 a"))),
    "csv, folders of windows, other case": Case(
        _HEAD + rows(_CSV, names=("C:\\x y\\LEFT.TIF", "..\\RIGHT.IMG", "D:\\img_2021-03 A.tif"))),
    "csv, folders and quotes": Case(_HEAD + rows(_CSV, names=('"/d, e/left.tif"', "./right.img", '"IMG_2021-03 a"'))),
    # --- degrees
    "dms, letters behind": Case("id;lat;lon;alt;img;px;py\n" + dms_rows("{d}°{m}'{s}\"{h}", P)),
    "dms, letters before, west": Case(
        "id;lat;lon;alt;img;px;py\n" + dms_rows("{h} {d} {m} {s}", WEST), points=WEST),
    "dms, decimal minutes, south": Case(
        "id;lat;lon;alt;img;px;py\n" + dms_rows("{d}° {mm}' {h}", SOUTH), points=SOUTH),
    "dms, colons and commas": Case(
        "id;lat;lon;alt;img;px;py\n" + comma(dms_rows("{d}:{m}:{s}{h}", P)), encoding="utf-16"),
    # --- reference systems, axes, units
    "utm, a column of codes": Case("p,epsg,X_utm,Y_utm,Z,image,col,row\n".replace("p,", "point,", 1)
                                   + rows("{p},32631,{x!r},{y!r},{z},{i},{c},{r}", UTM)),
    "utm, northing first, feet": Case(
        "pt;Northing;Easting;Elevation (ft);photo;column;line\n"
        + rows("{p};{y!r};{x!r};{z!r};{i};{c};{r}", scaled(UTM, FOOT)), frame=ControlReference("EPSG:32631")),
    "utm, german, decimal commas": Case(
        "Punkt;Rechtswert;Hochwert;H;image;col;row\n".replace("Punkt", "name")
        + comma(rows("{p};{x!r};{y!r};{z};{i};{c};{r}", moved("EPSG:25832"))), frame=ControlReference("EPSG:25832")),
    "utm south, in a comment": Case(
        "# CRS: EPSG:32760\nname,E,N,ellipsoidal height,image,col,row\n"
        + rows("{p},{x!r},{y!r},{z},{i},{c},{r}", moved("EPSG:32760", SOUTH)), points=SOUTH),
    "northing first by its system": Case(  # NZTM's axes are north, east: x stays the east
        "name,x_map,y_map,h,image,col,row\n" + rows("{p},{x!r},{y!r},{z},{i},{c},{r}", moved("EPSG:2193", SOUTH)),
        frame=ControlReference("EPSG:2193"), points=SOUTH),
    "state plane, all in feet": Case(
        "name,east,north,z_ftUS,image,col,row\n"
        + rows("{p},{x!r},{y!r},{z!r},{i},{c},{r}", scaled(moved("EPSG:6418", at(-121.5, 38.5)), US_FOOT)),
        frame=ControlReference("EPSG:6418"), points=at(-121.5, 38.5)),
    "web mercator, case tells": Case(
        "name,X,Y,Z,x,y,image\n" + rows("{p},{x!r},{y!r},{z},{c},{r},{i}", moved("EPSG:3857")),
        frame=ControlReference("EPSG:3857")),
    "utm, units tell": Case(
        "gcp_name,E [m],N [m],h_ell [m],file,x [px],y [px]\n" + rows("{p},{x!r},{y!r},{z},{i},{c},{r}", UTM),
        frame=ControlReference("EPSG:32631")),
    "earth-centred": Case(
        "name,X,Y,Z,image,col,row\n" + rows("{p},{x!r},{y!r},{z!r},{i},{c},{r}", ECEF),
        frame=ControlReference("EPSG:4978")),
    "2-D csv": Case("name,lon,lat,image,col,row\n" + rows("{p},{x},{y},{i},{c},{r}"), flat=True),
    # --- formats
    "geojson": Case(geojson(), "g.geojson"),
    "geojson, marked, dos": Case(geojson(), "g.json", encoding="utf-8-sig", newline=DOS),
    "geojson, utf-16": Case(geojson(), "g.json", encoding="utf-16"),
    "geojson, 2-D": Case(geojson(size=2), "g.json", flat=True),
    "geojson, map coordinates": Case(geojson(UTM, crs=of_urn("urn:ogc:def:crs:EPSG::32631")), "g.json"),
    "geojson, degrees by a code": Case(geojson(crs=of_urn("EPSG:4326")), "g.json"),
    "geojson, degrees by a urn": Case(geojson(crs=of_urn("urn:ogc:def:crs:OGC:1.3:CRS84")), "g.json"),
    "geojson, numbers as texts": Case(
        json.dumps({"features": [feature(p, v, str(c), str(r), list(P[p])) for p, v, c, r in SEEN]}), "g.json"),  # type: ignore[arg-type]
    "qgis, marked, dos": Case(
        "#CRS: EPSG:4326\nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n" + _QGIS + "9,9,9,-9,0,0,0,0\n",
        "left.points", encoding="utf-8-sig", newline=DOS, seen=LEFT, flat=True),
    "qgis, map coordinates by flag": Case(
        "mapX,mapY,pixelX,pixelY,enable\n"
        + "".join(f"{UTM[p][0]!r},{UTM[p][1]!r},{c + 0.5},{-r - 0.5},1\n" for p, _, c, r in LEFT), "left.tif.points",
        frame=ControlReference("EPSG:32631"), seen=LEFT, flat=True),
    "odm, dos, comments": Case(
        "EPSG:32631\n# x y z\n" + "".join(
            f"{UTM[p][0]!r}\t{UTM[p][1]!r}\t{UTM[p][2]}\t{c + 0.5}\t{r + 0.5}\t{NAMED[v]}.JPG\t{p}\n"
            for p, v, c, r in SEEN if v < 2), "gcp_list.txt",
        newline=DOS, seen=tuple(row for row in SEEN if row[1] < 2)),
    "odm, zone of the south, utf-16": Case(
        "WGS84 UTM 60S\n" + "".join(
            f"{x!r} {y!r} {z} {c + 0.5} {r + 0.5} {NAMED[v]} {p}\n"
            for p, v, c, r in LEFT for x, y, z in (moved("EPSG:32760", SOUTH)[p],)), "gcp_list.txt",
        encoding="utf-16", points=SOUTH, seen=LEFT),
    "odm, names of images with blanks": Case(
        "EPSG:4326\n" + rows("{x} {y} {z} {c} {r} {i} {p}", more=0.5).replace("IMG_2021-03 a", '"IMG_2021-03 a"'),
        "gcp_list.txt"),
    "micmac": Case(micmac(), "g.xml"),
    "micmac, utf-16": Case(micmac().replace("'1.0'", "'1.0' encoding='utf-16'"), "g.xml", encoding="utf-16"),
    "micmac, map coordinates": Case(micmac(UTM), "g.xml", frame=ControlReference("EPSG:32631")),
    "envi, dos": Case(
        "; ENVI Image to Map GCP File\n; projection info = {UTM, 31, North, WGS-84, units=Meters}\n"
        "; Map (x,y), Image (x,y)\n;\n" + "".join(
            f"   {UTM[p][0]!r}  {UTM[p][1]!r}   {c + 1.5}  {r + 1.5}\n" for p, _, c, r in LEFT), "left.pts",
        newline=DOS, seen=LEFT, flat=True),
    "envi, utf-16, image first, south": Case(
        "; projection info = {UTM, 60, South, WGS-84, units=Meters}\n; Image (x,y), Map (x,y)\n" + "".join(
            f"{c + 1.5} {r + 1.5} {x!r} {y!r}\n" for p, _, c, r in LEFT
            for x, y, _ in (moved("EPSG:32760", SOUTH)[p],)), "left.pts",
        encoding="utf-16", points=SOUTH, seen=LEFT, flat=True),
    "asp": Case("# WKT: any\n" + _ASP, "g.gcp", seen=tuple(row for row in SEEN if row[1] < 2)),
    "asp, dos, marked": Case(
        _ASP, "g.gcp", encoding="utf-8-sig", newline=DOS, seen=tuple(row for row in SEEN if row[1] < 2)),
    "metashape": Case(
        "# CoordinateSystem: EPSG:32631\n#Label,Camera,X/Easting,Y/Northing,Z/Altitude,px,py,Error_(m)\n"
        + rows("{p},{i},{x!r},{y!r},{z},{c},{r},0.2", UTM, more=0.5), "markers.csv"),
}  # fmt: skip


CASES |= {
    f"one point, {name}": Case(
        text, file, points={"p": (LON, LAT, ALT)}, seen=(("p", 0, COL, ROW),), tolerance=1e-10, flat=name in NO_ALTITUDE
    )
    for name, (file, text) in SAME.items()
}


@pytest.mark.parametrize("name", CASES)
def test_the_points_of_a_file_are_where_they_are(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    (tmp_path / case.file).write_text(case.text, encoding=case.encoding, newline=case.newline)
    found = read_gcps(tmp_path / case.file, VIEWS, case.frame)
    places, seen = case.points or P, case.seen or SEEN
    np.testing.assert_allclose(found.xy, np.round(found.xy, 6), rtol=0, atol=1e-9)
    got = {
        (int(v), round(float(c), 6), round(float(r), 6)): found.lonlatalt[g]
        for g, v, (c, r) in zip(found.point, found.view, found.xy, strict=True)
    }
    wanted = {(v, c, r): (*places[p][:2], 0.0 if case.flat else places[p][2]) for p, v, c, r in seen}
    assert got.keys() == wanted.keys()
    for key, (lon, lat, alt) in wanted.items():
        assert abs((got[key][0] - lon + 180) % 360 - 180) <= case.tolerance, key
        assert abs(got[key][1] - lat) <= case.tolerance, key
        assert abs(got[key][2] - alt) <= 1e-6, key
    assert len(found.names) == len({p for p, *_ in seen})  # seen in two images, a point is one
    assert found.strangers == ()
    assert ("no altitudes" in "".join(found.said)) == case.flat
    assert all(line.startswith(str(tmp_path)) and "\n" not in line for line in found.said)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        # two hundred and forty and a half, or two thousand? either way nobody knows
        (comma(rows('{p},"{y}","{x}","{z}","{i}","{c}","{r}"')), "line 2: .*'240,5' is no number; decimal commas need"),
        (rows('{p},{y},{x},"1,{z}",{i},{c},{r}'), r"line 2: .*'1,240\.5' is no number\)"),
        (rows("{p},{y},{x},{z} m,{i},{c},{r}"), "line 2: .*'240.5 m' is no number"),
        (rows("{p};{y};{x};{z};{i};{c};{r}"), "line 2"),
        (rows(_CSV, {p: (y, x + 90, z) for p, (x, y, z) in P.items()}), None),  # for whoever knows the images
    ],
)
def test_what_may_mean_two_things_is_refused_in_one_line(text: str, says: str | None, tmp_path: Path) -> None:
    path = tmp_path / "control.csv"
    path.write_text(_HEAD + text)
    if says is None:
        assert read_gcps(path, VIEWS).lonlatalt[0, 1] == P["a"][0] + 90
        return
    refused(partial(read_gcps, names=VIEWS), path, says)
